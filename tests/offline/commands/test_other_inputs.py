"""A picture, a map or a log given where something else is wanted: one line says what it is and what to give."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.offline.maps.files import write_map
from tests.support.data.logs import drive, write_log
from tests.support.data.maps import make_map
from tests.support.programs import Run


@pytest.fixture
def things(tmp_path: Path) -> Path:
    """A folder with a picture, a map and the logs of two runs."""
    cv2.imwrite(str(tmp_path / "picture.jpg"), np.zeros((60, 80), dtype=np.uint8))
    for run_id in ("one", "two"):
        write_log(tmp_path / "logs" / run_id, drive(0.2))
    folder = tmp_path / "map"
    folder.mkdir()
    write_map(make_map(), folder)
    (folder / "map.mcap").write_bytes((tmp_path / "logs" / "one" / "0000.core.mcap").read_bytes())
    return tmp_path


IS_PICTURE = "picture.jpg: is a JPEG picture, not an MCAP file; give a log, which ends in .mcap"
IS_MAP = "map: is a map, not a log; give the logs of drives"
IS_LOG = "holds logs, not a map, which `map` makes of them; give the folder that `map -o` wrote"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("detect picture.jpg -o out", IS_PICTURE),
        ("salvage picture.jpg -o out", IS_PICTURE),
        ("salvage picture.jpg -o out.mcap", IS_PICTURE),
        ("info picture.jpg", IS_PICTURE),
        ("map picture.jpg -o out", IS_PICTURE),
        ("map map -o out", IS_MAP),
        ("map logs map -o out", IS_MAP),
        ("map map/map.mcap -o out", "map.mcap: is a map, not a log"),
        ("calibrate map -o out.yaml", IS_MAP),
        ("info map", IS_MAP),
        ("localize map --map map -o out", IS_MAP),
        ("detect map -o out", IS_MAP),
        ("salvage map -o out", IS_MAP),
        ("detect logs -o out", "logs: holds 2 runs; give one of them, as "),
        ("salvage logs -o out", "logs: holds 2 runs; give one of them, as "),
        ("compare logs --truth map/map.json", IS_LOG),
        ("compare logs/one --survey map/tags.csv", IS_LOG),
        ("export logs --format g2o -o out", IS_LOG),
        ("localize logs/one --map logs", IS_LOG),
        ("compare logs/one/0000.core.mcap --truth map/map.json", "is a file, not the folder of a map; give the folder"),
        ("compare nothing --truth map/map.json", "nothing: no such folder; give the folder that `map -o` wrote"),
        ("compare map --truth map/map.json", "map.json: is a map, not ground truth, which holds runs"),
    ],
)
def test_what_it_is_and_what_to_give_is_one_line(
    run: Run, things: Path, monkeypatch: pytest.MonkeyPatch, words: str, said: str
) -> None:
    monkeypatch.chdir(things)
    before = sorted(things.rglob("*"))
    outcome = run(*words.split())
    assert (outcome.code, outcome.out) == (1, "")
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1
    assert said in outcome.err
    assert sorted(things.rglob("*")) == before


def test_a_folder_with_one_run_is_that_run(run: Run, things: Path) -> None:
    (things / "logs" / "two" / "0000.core.mcap").unlink()
    assert run("salvage", things / "logs", "-o", things / "out").code == 0


def test_an_unknown_model_is_an_error_that_lists_the_models(run: Run, things: Path) -> None:
    outcome = run("map", things / "logs", "-o", things / "out", "--model", "3d")
    assert outcome.code == 2
    (line,) = [each for each in outcome.err.splitlines() if each.startswith("Error: ")]
    assert "'--model': '3d' is none of 2d (tags' positions on the floor) and corners (tags' corners" in line
