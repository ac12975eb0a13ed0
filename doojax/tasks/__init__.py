"""The tasks, by name."""

from doojax.tasks.base import Box as Box
from doojax.tasks.base import Phase as Phase
from doojax.tasks.base import Task as Task
from doojax.tasks.dual_gripper import DualGripper as DualGripper
from doojax.tasks.engine_bay import EngineBay as EngineBay
from doojax.tasks.grippers import gripper_goal as gripper_goal
from doojax.tasks.grippers import point_goal as point_goal
from doojax.tasks.planar_pushing import PlanarPushing as PlanarPushing
from doojax.tasks.registry import TASKS as TASKS
from doojax.tasks.registry import make_task as make_task
from doojax.tasks.registry import register as register
from doojax.tasks.rope_dragging import RopeDragging as RopeDragging
from doojax.tasks.starts import Place as Place
from doojax.tasks.toy import Toy as Toy
from doojax.tasks.two_hands import TwoHands as TwoHands
from doojax.tasks.two_hands import two_hands_scene as two_hands_scene
from doojax.tasks.watering import Watering as Watering
