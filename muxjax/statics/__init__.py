"""Elastic chains under tendons, weight and load: from tension or length to posture, and back.

``chain`` is the pytree, ``files`` reads and builds chains, ``loads`` what acts on them;
``kernel`` turns a posture into energy, residual and tangent (MODEL.md section 9), ``recursion``
solves its linear systems at linear cost, ``newton`` iterates, ``implicit`` differentiates.
``forward`` and ``inverse`` are the face.
"""

from muxjax.statics.chain import ElasticChain
from muxjax.statics.files import elastic_chain, load_chain
from muxjax.statics.forward import forward_statics
from muxjax.statics.inverse import InverseResult, inverse_statics
from muxjax.statics.posture import Posture, true_posture
from muxjax.statics.result import Equilibrium, StaticsError, StaticsStatus

__all__ = [
    "ElasticChain",
    "Equilibrium",
    "InverseResult",
    "Posture",
    "StaticsError",
    "StaticsStatus",
    "elastic_chain",
    "forward_statics",
    "inverse_statics",
    "load_chain",
    "true_posture",
]
