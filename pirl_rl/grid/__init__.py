"""The grid solver: V of problems with up to three states on a mesh, with an estimate of its error.

It solves the HJB equation, Eq. (hjb_pde), which is the limit of continuous observation and control, by the Markov chain
approximation (H. Kushner and P. Dupuis, Numerical Methods for Stochastic Control Problems in Continuous Time, 2001).
For each candidate control a Markov chain in continuous time jumps between the nodes of a mesh, and its drift and
covariance per unit of time are those of the SDE. All jump rates are >= 0, so that the scheme is monotone: V stays in
[0, 1], a larger target never lowers it, and the scheme converges to V (G. Barles and P. Souganidis, Asymptotic Analysis
4, 1991). Where the noise is weak beside the mesh, drift and noise act in turns instead, see `pirl_rl.grid.transport`.

Notation: N is the number of nodes, M the number of those outside A and B, K the number of candidate controls. Within
this room arrays are numpy's, in float64; positions are in SI units, and offsets are in units of the mesh.
"""

from pirl_rl.grid.solution import GridSolution
from pirl_rl.grid.solver import GridSolver

__all__ = ["GridSolution", "GridSolver"]
