"""report.html: the presentation of a map, in one file that opens from disk without a network."""

from pathlib import Path

from groundsbot.calib.foundation import atomic_write, plural
from groundsbot.offline.mapping import Diagnostics
from groundsbot.offline.maps import MapResult, map_as_json
from groundsbot.offline.report.accuracy_texts import key_figures
from groundsbot.offline.report.figures import figures
from groundsbot.offline.report.page import Opening, page
from groundsbot.offline.report.sentences import next_step, sentences
from groundsbot.offline.report.tables import tables
from groundsbot.offline.report.verdict import doubts, verdict, verdict_sentence


def write_report(result: MapResult, workings: Diagnostics, path: Path) -> None:
    """Write the report of a map.

    Args:
        result: the map.
        workings: intermediate results of the same map.
        path: path of the file.

    Raises:
        OSError: it cannot be written.
    """
    document = map_as_json(result)
    n_runs = len({run.run for run in result.runs})
    title = f"Map of {plural(n_runs, 'run')} and {plural(len(document['tags']), 'tag')}"
    n_components = len(document["components"])
    if n_components > 1:
        title += f", in {n_components} components"
    opening = Opening(
        title,
        verdict_sentence(document),
        verdict(document),
        next_step(document),
        key_figures(document),
        doubts(document),
    )
    text = page(
        opening,
        sentences(document),
        [*document["losses"], *document["warnings"]],
        tables(document),
        figures(document, workings),
    )
    with atomic_write(path) as partial:
        partial.write_text(text, encoding="utf-8")
