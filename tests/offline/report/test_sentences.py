"""What the report's sentences and tables make of a map."""

from dataclasses import replace
from typing import Any

import numpy as np

from groundsbot.offline.maps.datum import DatumKind, TagDatum
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.report.accuracy_texts import headline, key_figures
from groundsbot.offline.report.join_tables import essential_tags
from groundsbot.offline.report.sentences import heading_sentence, next_step, scale_sentence, sentences
from groundsbot.offline.report.tables import tables
from tests.support.data.maps import make_component, make_map, suspect_entry

PLACES_M = [[0.0, 0.0], [6.0, 8.0], [1.0, 1.0], [2.0, 3.0]]


def words_of(**changes: Any) -> str:
    return " ".join(sentences(map_as_json(make_map()) | changes))


def test_doubts_are_said() -> None:
    document = map_as_json(make_map())
    assert "Check this" not in words_of(checks=[], warnings=[])
    assert "There is one warning: the wheels slipped." in words_of(losses=[], warnings=["the wheels slipped."])
    assert "The map comes with 2 warnings, below." in words_of(losses=["a"], warnings=["b"])
    (check,) = document["checks"]
    told = words_of(checks=[check | {"sigmas": 7.2}])
    assert "wheels and tags of red contradict each other about a full turn by 1.00 % (7 sigma)" in told
    assert "1 tag is suspect: 3 (moved)" in words_of(suspect_tags=[suspect_entry(3)])
    (alignment,) = document["alignments"]
    told = words_of(alignments=[alignment | {"is_sure": False}])
    assert "1 alignment was uncertain and not used: red_one with blue_two" in told
    tags = [tag | {"n_observations": 2} for tag in document["tags"]]
    assert "3 tags were observed fewer than 3 times: 3, 7 and 3" in words_of(tags=tags)
    taped = document["measurements"][0] | {"contradicts": True}
    assert "1 measurement by hand does not fit the rest" in words_of(measurements=[taped])


def test_figures_and_headline_give_the_accuracy_of_each_component() -> None:
    two = map_as_json(make_map(make_component(), make_component("green_one", "grey_two")))
    size, shape, _ = key_figures(two)
    assert size.value == "6"
    assert size.note.count("3 tags over ") == 2
    assert "; component 2: 3 tags over " in size.note
    median, worst = shape.value.split(" · ")
    assert median == worst  # the same map twice
    assert "component 2: tag " in shape.note
    assert f"In component 1 tags are known to {median} relative to each other" in headline(two)
    assert f"in component 2 to {median} (tag " in headline(two)
    assert "grey_two" not in headline(two)
    five = map_as_json(make_map(*(make_component(f"a_{i}", f"b_{i}") for i in range(5))))
    assert headline(five).endswith("; 2 components more.")
    assert key_figures(five)[1].value.endswith(" · 2 more")


def test_the_scale_of_imported_drives_comes_from_their_ranges() -> None:
    document = map_as_json(make_map())
    document |= {"metres": [document["metres"][0] | {"shares": {"wheels": 0.25, "tags": 0.75}}]}
    (wheels,) = document["calibration"]
    assert "75 % of that from the size of the tags" in words_of(metres=document["metres"])
    imported = wheels | {"owner": "imported tag36h11", "name": "tag_scale"}
    told = words_of(metres=document["metres"], calibration=[wheels, imported])
    assert "75 % of that from the scale of the imported ranges" in told
    printed = imported | {"owner": "default tag36h11"}
    told = words_of(metres=document["metres"], calibration=[wheels, imported, printed])
    assert "75 % of that from the size of the tags" in told


def test_the_headline_says_what_sigmas_refer_to() -> None:
    def told(kind: DatumKind, weights: tuple[float, ...]) -> str:
        component = replace(make_component(), frame_run=None, datum=TagDatum(kind, np.array(weights)))
        return " ".join(sentences(map_as_json(make_map(component))))

    own = told(DatumKind.TAGS, (1.0, 1.0, 1.0))
    assert "All sigmas refer to the tags' own axes, so shift and turn of all tags together are not in them" in own
    two = told(DatumKind.PAIR, (1.0, 0.0, 1.0))
    assert "Relative to the axes of tags 3 and 3, they are known to " in two
    surveyed = told(DatumKind.SURVEY, (1.0, 0.0, 0.5))
    assert "Relative to the survey's frame, they are known to " in surveyed
    assert "as 2 surveyed tags hold it, without the survey's own errors" in surveyed
    assert "Relative to the start of red_one, whose heading" in words_of()


def test_how_to_fix_the_heading_is_told_where_it_is_most_of_the_sigmas() -> None:
    document = map_as_json(make_map())
    shape_m = float(np.median([tag["shape_sigma_m"] for tag in document["tags"]]))

    def told(times: float, **component: Any) -> str:
        tags = [tag | {"sigma_m": times * shape_m} for tag in document["tags"]]
        return heading_sentence(document | {"tags": tags, "components": [document["components"][0] | component]})

    assert "--frame A,B" in told(1.5)
    assert "(2.0 degrees)" in told(1.5, heading_sigma_rad=np.radians(2.0))
    assert told(1.4) == ""
    assert told(1.5, datum={"kind": "tags", "weights": [1.0, 1.0, 1.0]}) == ""
    assert told(1.5, heading_sigma_rad=None) == ""
    assert "only the wheels tell how far robots turn; a gyro" in told(1.5)
    document["calibration"] = [document["calibration"][0] | {"name": "gyro_scale"}]
    assert "only the wheels" not in told(1.5)


def test_a_measured_distance_is_advised_where_the_scale_is_most_of_the_largest_sigma() -> None:
    document = map_as_json(make_map())
    tags = [tag | {"component": 0, "position_m": place} for tag, place in zip(document["tags"], PLACES_M, strict=False)]
    tags = [tag | {"shape_sigma_m": 0.06 if i == 0 else 0.05} for i, tag in enumerate(tags)]

    def told(sigma: float) -> str:
        return scale_sentence(document | {"tags": tags, "metres": [{"component": 0, "sigma": sigma}]})

    middle_m = np.mean([tag["position_m"] for tag in tags], axis=0)
    away_m = float(np.linalg.norm(tags[0]["position_m"] - middle_m))
    assert told(0.7 * 0.06 / away_m) == ""
    assert "--distance" in told(0.72 * 0.06 / away_m)
    assert "about 10.0 m" in told(0.02)
    metres = [{"component": 0, "sigma": 0.02}]
    assert "by tape determines it" in next_step(document | {"tags": tags, "metres": metres, "suspect_tags": []})
    assert scale_sentence(document | {"metres": []}) == ""


def test_a_run_that_was_parted_is_one_run() -> None:
    runs = map_as_json(make_map())["runs"]
    parted = [*runs, runs[1] | {"run": "blue_two_stretch2", "stretch_of": "blue_two"}]
    assert "2 runs (red_one and blue_two; " in words_of(runs=parted)


def test_unknown_numbers_are_not_said() -> None:
    unknown = replace(make_component(), joint_covariance=np.full((12, 12), np.nan))
    tags = tuple(replace(tag, covariance=np.full((2, 2), np.nan)) for tag in unknown.tags)
    document = map_as_json(make_map(replace(unknown, tags=tags)))
    assert document["tags"][0]["sigma_m"] is None
    assert "nan" not in " ".join(sentences(document))
    (shown,) = [table for table in tables(document) if table.key == "tags"]
    assert not any("nan" in cell for row in shown.rows for cell in row)


def test_tags_without_which_runs_fall_apart() -> None:
    document = map_as_json(make_map())
    assert [tag["tag_id"] for tag in essential_tags(document, 0)] == [7, 3]
    more = [tag | {"runs": ["red_one", "blue_two"]} for tag in document["tags"]]
    assert essential_tags(document | {"tags": more}, 0) == []


def test_fitted_noise_is_told() -> None:
    document = map_as_json(make_map())
    parameters = [
        {"name": "sigma_corner_px", "value": 0.31, "low": 0.28, "high": 0.35, "redundancy": 200.0, "kept": ""},
        {
            "name": "sigma_range_m",
            "value": 0.02,
            "low": None,
            "high": None,
            "redundancy": 0.0,
            "kept": "no observation",
        },
    ]
    shared = dict.fromkeys(("shared_range", "shared_bearing", "pass_range", "pass_bearing"), 0.0)
    fit = {"parameters": parameters, "runs": ["a_one"], **shared, "contradicting": []}
    (noise,) = [table for table in tables(document | {"noise_fit": fit}) if table.key == "noise"]
    rows = {row[0]: row for row in noise.rows}
    assert rows["sigma_corner_px"][2:] == ("0.28 to 0.35", "0.2", "fitted")
    assert rows["sigma_range_m"][2:] == ("", "0.05", "no observation")
    assert "a_one" in noise.note
    assert "need no action" in noise.note
