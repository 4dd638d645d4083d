"""Compilation of the solver before its first use, in several processes.

`python -m groundsbot.offline.commands.compilation` does it as a part of an installation.
"""

from typing import Final

from groundsbot.offline.commands.progress_bar import progress_bar
from groundsbot.offline.commands.shared import echo_line
from groundsbot.offline.foundation import Stages, compile_ahead

# Modules with kernels that every map needs, by the time that they take to compile.
MODULES: Final = (
    "estimate.kernels",
    "sam.multifrontal.kernels",
    "sam.arrowhead.elimination",
    "sam.arrowhead.substitution",
    "sam.arrowhead.block_substitution",
    "sam.linearisation.odometry",
    "sam.linearisation.observations",
    "sam.arrowhead.fronts",
    "sam.arrowhead.marginals",
    "sam.linearisation.kernels",
    "sam.arrowhead.relative_retraction",
    "noise.lasting_errors",
    "measurements.keyframes",
    "sam.arrowhead.dissection",
    "sam.chain_covariances",
    "sam.linearisation.robust_losses",
    "self_calibration.pass_kernels",
    "measurements.covariance_components",
)


def compile_solver(stages: Stages) -> None:
    """Compile what every map needs, unless that was done since the last installation or update."""
    compile_ahead(MODULES, echo_line, stages)


if __name__ == "__main__":
    with progress_bar() as show:
        compile_solver(Stages(show))
