"""The problems that come with the package, one file each, or one folder if a problem has more than its physics.

They are extensions like those of a user: a configuration names them, and no general module of the package imports them.
"""

from pirl_rl.problems.cartpole import CartPole
from pirl_rl.problems.double_integrator import DoubleIntegrator
from pirl_rl.problems.drift.problem import VehicleDrift
from pirl_rl.problems.drift.three_state import VehicleDrift3
from pirl_rl.problems.dubins import DubinsCar
from pirl_rl.problems.exit1d import Exit1D
from pirl_rl.problems.halfspace import HalfSpace
from pirl_rl.problems.pendulum import Pendulum
from pirl_rl.problems.quadrotor import PlanarQuadrotor
from pirl_rl.problems.radial_exit import RadialExit
from pirl_rl.problems.reach1d import Reach1D
from pirl_rl.problems.safety1d import Safety1D
from pirl_rl.problems.zermelo import ZermeloBoat

__all__ = [
    "CartPole",
    "DoubleIntegrator",
    "DubinsCar",
    "Exit1D",
    "HalfSpace",
    "Pendulum",
    "PlanarQuadrotor",
    "RadialExit",
    "Reach1D",
    "Safety1D",
    "VehicleDrift",
    "VehicleDrift3",
    "ZermeloBoat",
]
