"""Linking numbers, the grasp loop signature, and the skeletons that it counts passages through."""

from doojax.topology.field import field_line as field_line
from doojax.topology.field import magnetic_field as magnetic_field
from doojax.topology.grasp_loops import GraspLoops as GraspLoops
from doojax.topology.grasp_loops import Grasps as Grasps
from doojax.topology.grasp_loops import Holder as Holder
from doojax.topology.grasp_loops import loops_of as loops_of
from doojax.topology.grasp_loops import make_grasps as make_grasps
from doojax.topology.grasp_loops import signature as signature
from doojax.topology.linking import TOUCHING as TOUCHING
from doojax.topology.linking import Linking as Linking
from doojax.topology.linking import linking_number as linking_number
from doojax.topology.linking import linking_of as linking_of
from doojax.topology.signatures import Blocklist as Blocklist
from doojax.topology.signatures import Signature as Signature
from doojax.topology.signatures import distance as distance
from doojax.topology.signatures import same as same
from doojax.topology.skeletons import Skeleton as Skeleton
from doojax.topology.skeletons import make_skeleton as make_skeleton
from doojax.topology.skeletons import mesh_skeleton as mesh_skeleton
from doojax.topology.skeletons import obstacle_skeleton as obstacle_skeleton
from doojax.topology.skeletons import rectangle as rectangle
