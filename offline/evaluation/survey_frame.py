"""The frame of a survey in a map: which surveyed tags hold it, and where it lies."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.calib.geometry import fit_transform
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation.survey import FALSE_ALARM, compare_entries, match_entries
from groundsbot.offline.evaluation.survey_file import SurveyEntry
from groundsbot.offline.maps import Component, DatumKind, SurveyedTag, TagDatum


class SurveyFrame(NamedTuple):
    """A survey's frame in a component.

    Attributes:
        datum: the tags that hold it, weighted by 1 / sigma_m^2 relative to the best known.
        T_survey_map: (3,) pose of the component's frame in it.
        warnings: each entry that was left out as wrong, and whether the others contradict the drives.
    """

    datum: TagDatum
    T_survey_map: FloatArray
    warnings: tuple[str, ...]


def align_survey(component: Component, entries: Sequence[SurveyEntry]) -> SurveyFrame:
    """Align the tags of a component with their surveyed positions by weighted least squares.

    Entries that look wrong are left out, which takes four or more of them.

    Raises:
        OfflineError: the survey has fewer than two tags of the component, or all in one place, or one twice.
    """
    matched = match_entries(component, entries)
    if len(matched) < 2:
        raise OfflineError(
            f"the survey has {plural(len(matched), 'tag')} of the map, at least two in one component are needed; "
            "measure more tags, or give the survey of this place"
        )
    tags, measured = [i for i, _ in matched], [entries[k] for _, k in matched]
    compared = compare_entries(component, tags, measured)
    good = [k for k, entry in enumerate(compared.entries) if entry.verdict == "fits"]
    sigmas_m = np.array([measured[k].sigma_m for k in good])
    weights = np.zeros(len(component.tags))
    weights[[tags[k] for k in good]] = (sigmas_m.min() / sigmas_m) ** 2
    found = np.array([component.tags[tags[k]].position_m for k in good])
    T_survey_map = fit_transform(
        np.array([measured[k].position_m for k in good]), found, (sigmas_m.min() / sigmas_m) ** 2
    )
    warnings = [f"--frame survey: {entry.line()}; it does not hold the frame" for entry in compared.outliers]
    n_over = 2 * len(good) - 3
    chi_square = n_over * (compared.nees_per_dim or 0.0)
    if chdtrc(n_over, chi_square) < FALSE_ALARM:
        warnings.append(
            f"--frame survey: survey and drives contradict each other (chi-square {chi_square:.0f}, {n_over} "
            "expected); check the survey's unit, axes and tag ids with `compare --survey`"
        )
    tag_of_entry = {k: i for i, k in matched}
    places = [SurveyedTag(e.tag_id, e.instance, e.position_m, tag_of_entry.get(k)) for k, e in enumerate(entries)]
    return SurveyFrame(TagDatum(DatumKind.SURVEY, weights, tuple(places)), T_survey_map, tuple(warnings))
