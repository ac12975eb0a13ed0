"""Robots as arrays: where their links are, joints that bring tools to places, distances. No simulator."""

from doojax.robots.clearance import capsule_ends as capsule_ends
from doojax.robots.clearance import clearance as clearance
from doojax.robots.clearance import floor_distances as floor_distances
from doojax.robots.clearance import is_free as is_free
from doojax.robots.clearance import obstacle_distances as obstacle_distances
from doojax.robots.clearance import self_distance as self_distance
from doojax.robots.clearance import travel as travel
from doojax.robots.collisions import are_free as are_free
from doojax.robots.displacements import Displaced as Displaced
from doojax.robots.displacements import displaced as displaced
from doojax.robots.displacements import tools_towards as tools_towards
from doojax.robots.displacements import velocities as velocities
from doojax.robots.inverse import IkSettings as IkSettings
from doojax.robots.inverse import IkSolutions as IkSolutions
from doojax.robots.inverse import inverse_kinematics as inverse_kinematics
from doojax.robots.kinematics import link_poses as link_poses
from doojax.robots.kinematics import tool_jacobians as tool_jacobians
from doojax.robots.kinematics import tool_poses as tool_poses
from doojax.robots.many import solve_poses as solve_poses
from doojax.robots.robot import DUAL_ARM as DUAL_ARM
from doojax.robots.robot import Robot as Robot
from doojax.robots.robot import dual_arm as dual_arm
from doojax.robots.robot import read_robot as read_robot
