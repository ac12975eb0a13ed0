"""Planning with any dynamics where a reliability allows it (doojax.planning.rrt), and control by sampling."""

from doojax.goals import Goal as Goal
from doojax.goals import all_of as all_of
from doojax.planning.mppi import HostRollouts as HostRollouts
from doojax.planning.mppi import Mppi as Mppi
from doojax.planning.mppi import MppiSettings as MppiSettings
from doojax.planning.mppi import Nominal as Nominal
from doojax.planning.mppi import Rollouts as Rollouts
from doojax.planning.mppi import rolled_out as rolled_out
from doojax.planning.mppi import timed_rolled_out as timed_rolled_out
from doojax.planning.predicted import PredictedRollouts as PredictedRollouts
from doojax.planning.predicted import Unreliable as Unreliable
from doojax.planning.risk import Risk as Risk
from doojax.planning.rrt import HostDynamics as HostDynamics
from doojax.planning.rrt import Rrt as Rrt
from doojax.planning.rrt import search as search
from doojax.planning.settings import RrtSettings as RrtSettings
from doojax.planning.shortcut import shortened as shortened
from doojax.planning.simulated import SimulatedRollouts as SimulatedRollouts
from doojax.planning.simulated import simulated as simulated
from doojax.planning.simulated import simulated_start as simulated_start
from doojax.planning.tree import Plan as Plan
from doojax.planning.tree import Problem as Problem
from doojax.planning.tree import Tree as Tree
from doojax.planning.tree import check_problem as check_problem
from doojax.planning.tree import plan_of as plan_of
from doojax.planning.tree import require_reachable as require_reachable
