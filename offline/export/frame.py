"""A finished map in another frame than its own, for an export."""

from dataclasses import replace

import numpy as np

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.mapping import FrameChoice, in_frame, parse_frame
from groundsbot.offline.maps import Component, CrossCovariances


def in_frame_of(component: Component, text: str) -> tuple[Component, tuple[str, ...]]:
    """Return a component in the frame that `--frame` names, and warnings.

    A map does not keep the covariances of its calibration with the starts, nor those of tags' heights and rotations
    with their positions; so calibration is left out, and covariances of tags' poses in space are unknown.

    Raises:
        OfflineError: there is no such frame, or the component's tags cannot hold it.
    """
    choice = parse_frame(text)
    names = [run.name for run in component.runs]
    choice.check_run(names)
    if choice.datum is None and not choice.run:
        choice = FrameChoice(run=names[0], text=text)
    no_calibration = CrossCovariances(np.zeros((0, 3 * len(names))), None)
    framed = in_frame(replace(component, calibration=None), choice, lambda: no_calibration)
    if framed.reason:
        raise OfflineError(f"--frame {text}: {framed.reason}")
    return framed.component, framed.warnings
