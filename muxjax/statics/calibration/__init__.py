"""Calibration: a chain's stiffness, tendon elasticity, offsets and geometry from measured postures.

``measured`` reads the CSV file, ``parameters`` says what can be fitted and where it stands in the
chain and its file, ``fit`` is the least squares with its uncertainties, ``report`` writes the
fitted chain.
"""

from muxjax.statics.calibration.fit import Calibration, Estimate, calibrate
from muxjax.statics.calibration.measured import Measurements, read_measurements
from muxjax.statics.calibration.report import save_chain

__all__ = [
    "Calibration",
    "Estimate",
    "Measurements",
    "calibrate",
    "read_measurements",
    "save_chain",
]
