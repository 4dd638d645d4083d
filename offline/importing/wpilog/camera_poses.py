"""Camera-to-tag transforms beside their tags' ids, as inputs of AdvantageKit log them (Transform3d[] and int64[])."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic
from groundsbot.offline.importing.wpilog.structs import is_array, struct_name

_IDS: Final = "int64[]"
_TRANSFORM_BYTES: Final = 56
_MOST_ARRAYS: Final = 32  # of a camera's inputs
Poses = list[tuple[int, FloatArray]]  # id, and forward, left, up in m


def is_camera_poses(topic: WpiTopic) -> bool:
    """Whether a topic holds transforms of which each may be from the camera to a tag."""
    return is_array(topic) and struct_name(topic) == "Transform3d"


def read_camera_poses(log: WpiLog, topic: WpiTopic) -> dict[int, Poses]:
    """Return the tags of each record by its stamp in ns, in order of time; empty where no ids lie beside.

    Values that did not change are not logged again, so the ids are the last ones.

    Raises:
        OfflineError: a record is damaged.
    """
    ids_topic = _ids_beside(log, topic)
    if ids_topic is None:
        return {}
    events = [(record.stamp_us, 0, record.payload) for record in log.records(ids_topic)]
    events += [(record.stamp_us, 1, record.payload) for record in log.records(topic)]
    ids: list[int] = []
    frames: dict[int, Poses] = {}
    for stamp_us, is_poses, payload in sorted(events, key=lambda event: event[:2]):
        if len(payload) % (_TRANSFORM_BYTES if is_poses else 8):
            raise OfflineError(
                f"{log.path}: {(topic if is_poses else ids_topic).name}: the record at {stamp_us * 1e-6:.3f} s has "
                f"{len(payload)} bytes, which its type does not; is the log damaged? choose another with --tags-topic"
            )
        if not is_poses:
            ids = np.frombuffer(payload, dtype="<i8").tolist()
        elif stamp_us >= 0:
            places = np.frombuffer(payload, dtype="<f8").reshape(-1, 7)[:, :3]
            paired = zip(ids, places, strict=False) if len(ids) == len(places) else ()
            frames[stamp_us * 1000] = [(tag_id, place.astype(np.float64)) for tag_id, place in paired]
    return frames


def _ids_beside(log: WpiLog, topic: WpiTopic) -> WpiTopic | None:
    arrays = log.beside(topic, _IDS)
    beside = [each for each in arrays if "id" in each.last] if len(arrays) <= _MOST_ARRAYS else []
    return beside[0] if len(beside) == 1 else None
