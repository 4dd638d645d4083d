"""Local maps of drives, with the tags that do not belong apart."""

from collections.abc import Sequence

from groundsbot.offline.foundation import Stages
from groundsbot.offline.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements import Chain
from groundsbot.offline.outliers.odometry_breaks import split_where_broken
from groundsbot.offline.outliers.outliers import RunsAlone
from groundsbot.offline.sam import efforts_of


def local_maps_of(chains: Sequence[Chain], stages: Stages, times: int = 1) -> tuple[list[LocalMap], list[str]]:
    """Each chain solved alone, parted where its wheels lost the way, and what to say of that.

    Args:
        chains: stretches of runs.
        stages: told what is being done.
        times: how often the command maps the runs; what they are worth is shared out.
    """
    maps: list[LocalMap] = []
    with stages.stage("local maps", len(chains)) as done:
        efforts = efforts_of(chains, times)
        for chain, effort in zip(chains, efforts, strict=True):
            maps.append(solve_local_map(chain, effort))
            done()
    alone = RunsAlone()
    with stages.stage("tags that do not belong"):
        maps = [alone.explained_by_tags(each) for each in maps]
    with stages.stage("breaks of odometry"):
        maps, broken = split_where_broken(maps, efforts)
    with stages.stage("tags that do not belong"):
        return [alone.split(each).without_factors() for each in maps], broken
