"""Tag detection in the pictures of a bag."""

import os
from collections.abc import Iterator

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import plural
from groundsbot.calib.robot import Robot
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Progress
from groundsbot.offline.importing.bags.content import BagClock
from groundsbot.offline.importing.bags.pictures import picture_of
from groundsbot.offline.importing.bags.reader import Bag, BagTopic
from groundsbot.offline.importing.bags.topics import BagOptions
from groundsbot.offline.importing.run_writer import Entry
from groundsbot.offline.logs import detect_in_parallel, detectors
from groundsbot.onboard.detection import DetectorSettings, detections_message
from groundsbot.onboard.log import Picture, StampSource


def detect_in_bag(
    bag: Bag, topic: BagTopic, camera: CameraModel, robot: Robot, options: BagOptions, progress: Progress
) -> tuple[list[Entry], list[str]]:
    """Return messages for `/tags/detections` from the pictures of a topic, in order of time, and remarks for the user.

    Args:
        bag: open.
        topic: topic of the pictures.
        camera: that took them.
        robot: has the families of tags to look for.
        options: options of the command line.
        progress: called with the number of pictures that are done.

    Raises:
        GroundsbotError: the bag is damaged, pictures have no times, do not match the camera's size or cannot be read,
            or no detector is installed.
    """
    clock = BagClock(bag.path, options)
    families = tuple(robot.recorder.families)
    settings = DetectorSettings(families, robot.recorder.detector, quad_decimate=1.0, camera=camera)
    found: dict[int, Entry] = {}
    unusable, n_processes = [], os.cpu_count() or 1
    with detectors(settings, n_processes) as (detect, library, described):
        pictures = _pictures(bag, topic, clock)
        for n_done, (stamp_ns, result) in enumerate(detect_in_parallel(pictures, detect, n_processes), start=1):
            progress("looking for tags", n_done, topic.n_messages)
            if result.error is not None:
                unusable.append(result.error)
                continue
            if result.size_px != (camera.width_px, camera.height_px):
                raise OfflineError(
                    f"{bag.path}: {topic.name}: a picture is {result.size_px[0]}x{result.size_px[1]} px, the camera's "
                    f"calibration is for {camera.width_px}x{camera.height_px} px; choose the one that belongs to the "
                    "pictures with --camera-info-topic"
                )
            source = StampSource.STAMP_SOURCE_UNSPECIFIED
            message = detections_message(result.detections, result.size_px, stamp_ns, source, 0, library, described)
            found[stamp_ns] = (stamp_ns, "/tags/detections", message)
    clock.check([topic])
    if not found:
        raise OfflineError(f"{bag.path}: {topic.name}: no picture can be used: {unusable[0]}; name another topic")
    left_out = [f"{plural(len(unusable), 'picture')} not usable, the first since: {unusable[0]}"] if unusable else []
    return [found[stamp] for stamp in sorted(found)], [*clock.remarks(), *left_out]


def _pictures(bag: Bag, topic: BagTopic, clock: BagClock) -> Iterator[tuple[int, Picture]]:
    for each in bag.messages([topic]):
        if (stamp_ns := clock.stamp_ns(each)) is not None:
            yield stamp_ns, picture_of(f"{bag.path}: {topic.name}", each.msgtype, each.content)
