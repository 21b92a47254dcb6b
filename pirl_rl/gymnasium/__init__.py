"""Problems as environments of Gymnasium. The import registers the problems that come with the package.

import gymnasium
import pirl_rl.gymnasium

env = gymnasium.make("pirl_rl/Reach1D-v0")
paths = gymnasium.make_vec("pirl_rl/Reach1D-v0", num_envs=64)
"""

from pirl_rl.gymnasium.environments import ReachAvoidGym, ReachAvoidVectorGym, observation
from pirl_rl.gymnasium.filtered import FilteredGym, FilteredVectorGym
from pirl_rl.gymnasium.registration import make, make_vector, register_problems

__all__ = [
    "FilteredGym",
    "FilteredVectorGym",
    "ReachAvoidGym",
    "ReachAvoidVectorGym",
    "make",
    "make_vector",
    "observation",
    "register_problems",
]

register_problems()
