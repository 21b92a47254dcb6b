"""V, its gradient and the policy of a run as one file, for programs that do not have this package.

A model maps times to go tau (N,) in s and states x (N, n) in SI units to V (N,), its gradient (N, n) and the control
(N, m) in SI units. Scaling, wrapping of periodic coordinates, the levels of the sets and the masks of A and B are
inside it. It is a graph of tensor operations, see `pirl_rl.deployment.graph`, in one of two formats: ONNX, which
onnxruntime executes without torch, or a program of `torch.export`.
"""

from pirl_rl.deployment.description import describe
from pirl_rl.deployment.model import FORMATS, write_model
from pirl_rl.deployment.program import Program

__all__ = ["FORMATS", "Program", "describe", "write_model"]
