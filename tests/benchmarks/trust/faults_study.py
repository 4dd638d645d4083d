"""Real recordings with one fault each: is it named as what it is, and is anything else named?

    python -m tests.benchmarks.trust.faults_study [--data ../shared/data] [--sets ds2,ds4,ds6,ds9]
        [--bases whole,p12,p34] [--faults exchanged,moved,clock,wheels,lifted,cut,misread] [--jobs 1]

The sets of MRCLAM whole, and two pairs of robots of each. What a fault does follows from the map of the same drives
without it: a landmark that was moved is read at its new place from the poses of that map, where the camera has it in
view. `moved` and `exchanged` have a size in sigmas by the maps of the single robots: of a shift between the robots with
the fault and the others, a second such tag being free. `clock` and `wheels` have one by the map's sigma of that number,
`misread` by the distance of the two tags; `lifted` and `cut` have none and count as clear. Exit 1 where fewer than 95 %
of those beyond six sigmas are named as what they are, or any other tag or motion is that is not without the fault.
"""

import argparse
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Final, NamedTuple
from zlib import crc32

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.parameters import TIME_OFFSET, WHEEL_PARAMETERS
from groundsbot.offline.commands.map_drives import exit_code as exit_code_of_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.outliers.kinds import MOVED, PHANTOM
from groundsbot.offline.self_calibration.robot_table import AGREES, NOT_OBSERVABLE
from tests.benchmarks.command_line import exit_code, say
from tests.benchmarks.trust import parts_study as parts

CLEAR_SIGMAS, NAMED_SHARE = 6.0, 0.95
CLOCK_S, WHEELS, LIFTED_M, CUT_S = 0.3, 1.1, 1.0, 60.0
READING_SIGMA_M: Final = 0.15  # of a misread reading's place, generously
LEAST_READINGS: Final = 20  # of a tag that something is done to, on both sides
ODOMETRY, OBSERVATIONS = "odometry.csv", "observations.csv"


class Fault(NamedTuple):
    """One thing that goes wrong, for some robots; 0: for all but one."""

    kind: str
    n_tags: int = 1
    shift_m: float = 0.0
    n_robots: int = 1
    n_readings: int = 0

    def __str__(self) -> str:
        moved = f"_{self.n_tags}x{self.shift_m:g}m_{f'r{self.n_robots}' if self.n_robots else 'rest'}"
        return self.kind + {"moved": moved, "misread": f"_{self.n_readings}"}.get(self.kind, "")


FAULTS: Final = (
    Fault("exchanged", n_tags=2),
    *(Fault("moved", n, shift_m, k) for n, shift_m, k in product((1, 2), (0.2, 0.5, 2.0), (1, 2, 0))),
    *(Fault(kind) for kind in ("clock", "wheels", "lifted", "cut")),
    *(Fault("misread", n_readings=n) for n in (1, 2, 4, 10, 20)),
)


class Clean(NamedTuple):
    """A map without a fault, in the survey's axes."""

    tracks: dict[str, FloatArray]  # (K, 4) t_s, x_m, y_m, heading in rad of each robot
    information: FloatArray  # (2 T, 2 T) of the surveyed tags relative to each other, in the order of ids
    numbers: dict[tuple[str, str], tuple[float, float]]  # by owner and name, with its sigma
    warnings: tuple[str, ...]
    named: tuple[str, ...]


class Row(NamedTuple):
    """What was done, to which tags, of which size, and what came of it."""

    words: str
    tags: Sequence[int] = ()
    sigmas: float = np.nan
    motion: tuple[str, float, float] = ("", np.nan, np.nan)  # robot, begin and end in s since its start
    number: tuple[str, float, float] = ("", np.nan, np.nan)  # name, value without the fault and with it
    kind: str = ""
    named: bool = False
    right: bool = False
    others: Sequence[str] = ()
    said: str = ""

    def __str__(self) -> str:
        size = "no size" if np.isnan(self.sigmas) else f"{self.sigmas:.1f} sigmas"
        verdict = "right" if self.right else "named, but not as what it is" if self.named else "not named"
        others = f", others named: {', '.join(self.others)}" if self.others else ""
        return f"{self.words}, {size}: {verdict}{others} | {self.said}"


class Scene(NamedTuple):
    """Drives to do a fault to, and what their maps say without it: of all together, and of each robot alone."""

    drives: dict[str, dict[str, FloatArray]]  # rows of each robot's files
    survey: parts.Survey
    clean: Clean
    alone: Mapping[str, Clean]
    fault: Fault
    robots: Sequence[str]
    rng: np.random.Generator

    def poses_at(self, robot: str, t_s: FloatArray) -> FloatArray:
        """Poses (n, 3) by the map."""
        track = self.clean.tracks[robot]
        return np.column_stack([np.interp(t_s, track[:, 0], column) for column in track.T[1:]])

    def choose_tags(self) -> list[int]:
        """Tags that the robots read often enough, and the others too."""
        n = Counter((i, name in self.robots) for name, f in self.drives.items() for i in f[OBSERVATIONS][:, 1].tolist())
        shared = [each for each in sorted(self.survey) if min(n[each, True], n[each, False]) >= LEAST_READINGS]
        return [int(each) for each in self.rng.choice(shared, self.fault.n_tags, replace=False)]

    def sigmas_of(self, shifts_m: Mapping[int, FloatArray]) -> float:
        """The smallest size of shifts of tags, as the robots see them and the others do not."""
        those = np.sum([self.alone[robot].information for robot in self.robots], axis=0)
        both = np.sum([self.alone[robot].information for robot in self.drives], axis=0)
        rows = np.concatenate([2 * sorted(self.survey).index(i) + np.arange(2) for i in shifts_m])
        shared = those[np.ix_(rows, rows)] - those[rows] @ np.linalg.pinv(both, hermitian=True) @ those[:, rows]
        covariance = np.linalg.inv(shared + 1e-6 * np.eye(len(rows)))  # of what nobody compares a kilometre
        own = [covariance[k : k + 2, k : k + 2] for k in range(0, len(rows), 2)]
        return float(min(d @ np.linalg.solve(C, d) for C, d in zip(own, shifts_m.values(), strict=True)) ** 0.5)

    def exchange(self) -> Row:
        """Two tags have each other's id."""
        a, b = self.choose_tags()
        ids = self.drives[self.robots[0]][OBSERVATIONS][:, 1]
        ids[:] = np.where(ids == a, b, np.where(ids == b, a, ids))
        off_m = self.survey[b] - self.survey[a]
        return Row(f"tags {a} and {b} exchanged", (a, b), self.sigmas_of({a: off_m, b: -off_m}))

    def move(self) -> Row:
        """Tags are elsewhere: of eight directions the one that leaves most readings in view."""
        shifts_m = {}
        for tag_id in self.choose_tags():
            angles = self.rng.uniform(0.0, np.pi / 4) + np.arange(8) * np.pi / 4
            tried_m = self.fault.shift_m * np.column_stack([np.cos(angles), np.sin(angles)])
            moved = [[self.move_readings(robot, tag_id, each) for robot in self.robots] for each in tried_m]
            best = int(np.argmax([sum(map(len, each)) for each in moved]))
            shifts_m[tag_id] = tried_m[best]
            for robot, rows in zip(self.robots, moved[best], strict=True):
                self.drives[robot][OBSERVATIONS] = rows
        return Row(f"{[*shifts_m]} moved by {self.fault.shift_m} m", tuple(shifts_m), self.sigmas_of(shifts_m))

    def move_readings(self, robot: str, tag_id: int, shift_m: FloatArray) -> FloatArray:
        """Readings (M, 4) with one tag elsewhere, if in view; ranges are depths, and stamps as late as the map says."""
        rows = self.drives[robot][OBSERVATIONS].copy()
        late_s, yaw_rad = (self.clean.numbers.get((robot, name), (0.0,))[0] for name in (TIME_OFFSET, "mount_yaw_rad"))
        heading = self.poses_at(robot, rows[:, 0] - late_s)[:, 2] + yaw_rad
        ahead = np.column_stack([np.cos(heading), np.sin(heading)])
        depth_m = rows[:, 2] + ahead @ shift_m
        left_m = rows[:, 2] * np.tan(rows[:, 3]) + ahead @ np.array([shift_m[1], -shift_m[0]])
        bearing, is_other = np.arctan2(left_m, depth_m), rows[:, 1] != tag_id
        in_view = (depth_m > rows[:, 2].min()) & (depth_m < rows[:, 2].max()) & (abs(bearing) < abs(rows[:, 3]).max())
        rows[~is_other, 2:] = np.column_stack([depth_m, bearing])[~is_other]
        return np.asarray(rows[in_view | is_other])

    def change_number(self) -> Row:
        """Late stamps, or wheels of another size."""
        (robot,), is_clock = self.robots, self.fault.kind == "clock"
        changed = self.drives[robot][OBSERVATIONS][:, :1] if is_clock else self.drives[robot][ODOMETRY][:, 1:]
        changed[:] = changed + CLOCK_S if is_clock else changed * WHEELS
        name = TIME_OFFSET if is_clock else WHEEL_PARAMETERS[0]
        before, sigma = self.clean.numbers.get((robot, name), (np.nan, np.nan))
        after = before + CLOCK_S if is_clock else before / WHEELS
        return Row(f"{before:.3f} to be {after:.3f}", sigmas=abs(after - before) / sigma, number=(name, before, after))

    def hide_motion(self) -> Row:
        """A minute is missing in which the robot gets away; or wheels stand still for a quick metre with a turn."""
        (robot,), is_cut, found = self.robots, self.fault.kind == "cut", []
        rows = self.drives[robot][ODOMETRY]
        t_s = np.arange(rows[0, 0], rows[-1, 0], 0.5)
        poses, most = self.poses_at(robot, t_s), round(CUT_S / 0.5)
        for i in range(most, len(t_s) - 2 * most):
            is_away = np.hypot(*(poses[i : i + most + 1, :2] - poses[i, :2]).T) >= LIFTED_M
            j = most if is_cut else int(np.argmax(is_away))
            found += [(j, abs(abs(float(poses[i + j, 2] - poses[i, 2])) - np.pi / 2), i, i + j)] if is_away[j] else []
        quick = [each for each in found if each[0] <= max(10, 1.5 * min(found)[0])]
        _, _, i, j = found[self.rng.integers(len(found))] if is_cut else min(quick, key=lambda each: each[1])
        is_hidden = (rows[:, 0] > t_s[i]) & (rows[:, 0] <= t_s[j])
        rows[is_hidden, 1:] = 0.0
        self.drives[robot][ODOMETRY] = rows[~is_hidden] if is_cut else rows
        begin_s, end_s, turn_rad = t_s[i] - t_s[0], t_s[j] - t_s[0], poses[j, 2] - poses[i, 2]
        return Row(f"{begin_s:.1f} to {end_s:.1f} s, {turn_rad:.1f} rad", motion=(robot, begin_s, end_s))

    def misread(self) -> Row:
        """Readings of a tag without 2 s between any two have the id of one that is not in sight."""
        rows, n, found = self.drives[self.robots[0]][OBSERVATIONS], self.fault.n_readings, []
        for tag_id in sorted(self.survey):
            own = np.flatnonzero(rows[:, 1] == tag_id)
            sight = np.cumsum(np.diff(rows[own, 0], prepend=0.0) > 2.0)
            found += [(tag_id, own[k : k + n]) for k in range(len(own) - n + 1) if sight[k] == sight[k + n - 1]]
        tag_id, run = found[self.rng.integers(len(found))]
        begin_s, end_s = rows[run[[0, -1]], 0].tolist()
        in_sight = rows[(rows[:, 0] > begin_s - 2.0) & (rows[:, 0] < end_s + 2.0), 1].astype(int).tolist()
        read_as = int(self.rng.choice(sorted(self.survey.keys() - {*in_sight})))
        rows[run, 1] = read_as
        sigmas = float(np.linalg.norm(self.survey[read_as] - self.survey[tag_id])) / READING_SIGMA_M
        return Row(f"{tag_id} read as {read_as} at {begin_s:.3f} s", (read_as,), sigmas)


def clean_map(case: parts.Case, data: Path) -> Clean:
    """Map drives as they are."""
    survey, result = parts.survey_of(case.set_name, data), parts.map_drives(parts.read_drives(case, data))
    fit, tracks = parts.fit_survey(result.components[0], survey), dict[str, FloatArray]()
    for run in sorted(result.components[0].runs, key=lambda each: int(each.stamps_ns[0])):
        xy_m = (run.T_map_base[:, :2] - fit.centre_m) @ fit.turn + fit.true_centre_m
        heading = run.T_map_base[:, 2] - np.arctan2(fit.turn[1, 0], fit.turn[0, 0])
        track = np.column_stack([run.stamps_ns * 1e-9, xy_m, heading])
        tracks[run.robot_id] = np.concatenate([tracks.get(run.robot_id, track[:0]), track])
        tracks[run.robot_id][:, 3] = np.unwrap(tracks[run.robot_id][:, 3])
    information, turns = np.zeros((2 * len(survey), 2 * len(survey))), np.kron(np.eye(len(fit.ids)), fit.turn)
    rows = np.array([2 * sorted(survey).index(i) + axis for i in fit.ids for axis in (0, 1)], int)
    information[np.ix_(rows, rows)] = turns.T @ fit.information @ turns
    numbers = {(each.owner, each.name): (each.found, each.sigma) for each in result.robot_numbers}
    return Clean(tracks, information, numbers, result.warnings, parts.named_tags(result))


def _judge_tags(scene: Scene, done: Row, result: MapResult) -> tuple[bool, bool]:
    """All tags are named; as what they are, and by the robots on one side of the fault."""
    found = [each for each in result.outliers if each.tag_id in done.tags and each.kind != PHANTOM]
    named = {each.tag_id for each in found} == {*done.tags}
    is_kind = [each.kind == MOVED if scene.fault.kind == "moved" else each.swapped_with in done.tags for each in found]
    sides = [{name.split("_")[0] in scene.robots for name in each.runs} for each in found]
    return named, named and all(is_kind) and all(len(each) == 1 for each in sides)


def _judge_number(scene: Scene, done: Row, result: MapResult) -> tuple[bool, bool]:
    """The number is said to differ from the file, by half of what was done or more; by what was done to a fifth."""
    name, before, after = done.number
    found = [each for each in result.robot_numbers if each.owner in scene.robots and each.name == name]
    off = [(each.found - before) / (after - before) for each in found if each.verdict not in (AGREES, NOT_OBSERVABLE)]
    return any(each > 0.5 for each in off), any(abs(each - 1.0) < 0.2 for each in off)


def _judge_motion(_scene: Scene, done: Row, result: MapResult) -> tuple[bool, bool]:
    """The motion is told."""
    found = _is_told(done.motion, _motions(result.warnings))
    return found, found


def _motions(warnings: Sequence[str]) -> list[tuple[str, float, float]]:
    """Those of a map, which it tells in words only."""
    times = [(each, re.findall(r"([\d.]+) s (?:to|and) ([\d.]+) s", each)) for each in warnings]
    return [(each.split("_")[0], float(begin), float(end)) for each, found in times for begin, end in found]


def _is_told(motion: tuple[str, float, float], among: Sequence[tuple[str, float, float]]) -> bool:
    return any(motion[0] == name and motion[1] < end + 2.0 and motion[2] > begin - 2.0 for name, begin, end in among)


def _judge_misread(scene: Scene, done: Row, result: MapResult) -> tuple[bool, bool]:
    """The id is named; as a phantom, or the readings are left out as misread."""
    kinds = [each.kind for each in result.outliers if each.tag_id in done.tags]
    words = rf"\n{scene.robots[0]}_.*: (\d+) of \d+ observations are single"  # the map says it in words only
    told = ["\n".join(["", *warnings]) for warnings in (result.warnings, scene.clean.warnings)]
    now, before = (sum(map(int, re.findall(words, each))) for each in told)
    right = kinds == [PHANTOM] or (not kinds and now - before >= 0.8 * scene.fault.n_readings)
    return bool(kinds) or right, right


_KINDS: Final = {
    "exchanged": (Scene.exchange, _judge_tags), "moved": (Scene.move, _judge_tags),
    "clock": (Scene.change_number, _judge_number), "wheels": (Scene.change_number, _judge_number),
    "lifted": (Scene.hide_motion, _judge_motion), "cut": (Scene.hide_motion, _judge_motion),
    "misread": (Scene.misread, _judge_misread),
}  # fmt: skip


def study(task: tuple[parts.Case, Fault, Clean, Mapping[str, Clean]], data: Path) -> Row:
    """Do one fault to drives, map them, and judge what is named."""
    case, fault, clean, alone = task
    tables, seed = parts.read_drives(case, data), crc32(f"{case.name} {fault}".encode())
    drives = {robot: {file: np.array(rows[1:], float) for file, rows in each.items()} for robot, each in tables.items()}
    rng = np.random.default_rng(seed)
    robots = sorted(rng.choice(sorted(drives), fault.n_robots or len(drives) - 1, replace=False).tolist())
    scene = Scene(drives, parts.survey_of(case.set_name, data), clean, alone, fault, robots, rng)
    do, judge = _KINDS[fault.kind]
    done = do(scene)
    done = done._replace(kind=fault.kind, words=f"{case.name} {fault} (seed {seed}), {' '.join(robots)}: {done.words}")
    for robot, file in product(drives, (ODOMETRY, OBSERVATIONS)):
        tables[robot][file][1:] = [[f"{v:.13g}" for v in row] for row in drives[robot][file].tolist()]
    try:
        result = parts.map_drives(tables)
    except Exception as error:  # the other maps of a study of hours are wanted all the same
        return done._replace(said=f"no map: {type(error).__name__}: {error}")
    named, right = judge(scene, done, result)
    others = [t for t in parts.named_tags(result) if t not in clean.named and int(t.split()[0]) not in done.tags]
    motions = [m for m in _motions(result.warnings) if not _is_told(m, [*_motions(clean.warnings), done.motion])]
    others += [f"motion of {robot} from {begin_s} to {end_s} s" for robot, begin_s, end_s in motions]
    said = [f"{each.tag_id} {each.kind} ({', '.join(each.runs)})" for each in result.outliers]
    numbers = [each for each in result.robot_numbers if each.owner in robots and each.name == done.number[0]]
    said += [f"{each.name} {each.found:.3f} (sigma {each.sigma:.3f}), {each.verdict}" for each in numbers]
    said += [*(each for each in result.warnings if each not in clean.warnings), f"exit {exit_code_of_map(result)}"]
    return done._replace(named=named, right=right, others=others, said="; ".join(said))


def counts(name: str, rows: Sequence[Row]) -> str:
    """How many of some faults are clear and how many named, and in how many maps something else is."""
    clear = [row for row in rows if not row.sigmas <= CLEAR_SIGMAS]  # or without a size
    named, right, others = sum(r.named for r in clear), sum(r.right for r in clear), sum(bool(r.others) for r in rows)
    return f"{name}: {len(rows)} maps, {len(clear)} clear, {named} named, {right} as what they are; others in {others}"


def main(arguments: Sequence[str] | None = None) -> int:
    """The study as a program; returns its exit code."""
    parser, kinds = argparse.ArgumentParser(description="Real recordings with one fault each."), ",".join(_KINDS)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="real recordings [../shared/data]")
    parser.add_argument("--sets", default=",".join(parts.SETS), help=f"[{','.join(parts.SETS)}]")
    parser.add_argument("--bases", default="whole,p12,p34", help="drives of a set [whole,p12,p34]")
    parser.add_argument("--faults", default=kinds, help=f"kinds, or single ones as moved_2x0.5m_r1 [{kinds}]")
    parser.add_argument("--jobs", type=int, default=1, help="maps at a time [1]")
    options = parser.parse_args(arguments)
    sets, bases, wanted = (each.split(",") for each in (options.sets, options.bases, options.faults))
    faults = [each for each in FAULTS if each.kind in wanted or str(each) in wanted]
    if unknown := {*wanted} - {name for each in FAULTS for name in (each.kind, str(each))}:
        parser.error(f"--faults: {', '.join(sorted(unknown))}: unknown; there are {', '.join(map(str, FAULTS))}")
    every = {case.name: case for name in sets for case in parts.cases_of(name)}
    cases = [every[f"{name}_{base}".removesuffix("_whole")] for name, base in product(sets, bases)]
    pairs = [(c, each) for c, each in product(cases, faults) if each.n_robots == 1 or len(c.robots) > 2]
    of_tags = [case for case, each in pairs if each.kind in ("exchanged", "moved")]
    single = sorted({f"{case.set_name}_r{robot}" for case in of_tags for robot in case.robots})
    without, clean, rows = [*cases, *(every[name] for name in single)], dict[str, Clean](), []
    with ProcessPoolExecutor(options.jobs, get_context("spawn")) as pool:
        for case, found in zip(without, pool.map(partial(clean_map, data=options.data), without), strict=True):
            clean[case.name] = found
            say(f"{case.name} without a fault: {', '.join(found.named) or 'nothing'} named")
        alone = {name: {f"robot{each[-1]}": clean[each] for each in single if each.startswith(name)} for name in sets}
        tasks = [(case, fault, clean[case.name], alone[case.set_name]) for case, fault in pairs]
        for row in pool.map(partial(study, data=options.data), tasks):
            rows.append(row)
            say(str(row))
    for kind in (*dict.fromkeys(row.kind for row in rows), "all"):
        say(counts(kind, [row for row in rows if kind in (row.kind, "all")]))
    right = [row.right for row in rows if not row.sigmas <= CLEAR_SIGMAS]
    missed = [f"{row.words}: {', '.join(row.others)} named too" for row in rows if row.others]
    if right and np.mean(right) < NAMED_SHARE:
        missed.append(f"{np.mean(right):.3f} of clear faults named as what they are, at least {NAMED_SHARE}")
    return exit_code(missed)


if __name__ == "__main__":
    sys.exit(main())
