"""Logs of at most 1 MiB made to take memory and time."""

import struct
import zlib
from collections.abc import Callable, Iterable, Sequence

import cv2
import numpy as np
import zstandard
from mcap.records import Channel, Chunk, Footer, Statistics
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from groundsbot.onboard.log.messages import (
    CameraCalibration,
    CompressedImage,
    PlanarOdometry,
    TagDetection,
    TagDetections,
    TagObservation,
    TagObservations,
    WheelEncoders,
)
from tests.support.data.logs import ROBOT_YAML, START_NS
from tests.support.hostile.log_bytes import LIMIT_BYTES, MS, Content, bytes_of, chunk, full, log, of_messages, run

_CORNERS_PX = [10.0, 10.0, 20.0, 10.0, 20.0, 20.0, 10.0, 20.0]


def wheels(count: int, make: Callable[[int], WheelEncoders]) -> bytes:
    return of_messages(*(("/wheels", make(index), START_NS + index) for index in range(count)))


def observation(index: int, period_ns: int, boot_id: int = 1) -> WheelEncoders:
    return WheelEncoders(stamp_ns=START_NS + index * period_ns, boot_id=boot_id, sequence=index)


def extreme_observation(index: int) -> WheelEncoders:
    most = (-1) ** index * ((1 << 63) - 1)
    return WheelEncoders(stamp_ns=most, sequence=(1 << 64) - 1 - index, ticks_left=most)


def claims() -> bytes:
    heads = [struct.pack("<BQ", code, 1 << bits) for code in (1, 3, 4, 6, 7, 9, 12) for bits in (30, 40, 62, 63)]
    return log(chunk(run()), *heads)


def bombs(mib: int, count: int) -> bytes:
    bomb = chunk(b"\0" * (mib << 20))
    return log(chunk(run()), *[bomb] * min(count, (LIMIT_BYTES - 4000) // len(bomb)))


def giant_bomb(mib: int) -> bytes:
    """One chunk of nothing but zeros, whose length and checksum are right."""
    packing, block, crc, packed = zstandard.ZstdCompressor(19).compressobj(mib << 20), bytes(1 << 20), 0, b""
    for _ in range(mib):
        packed += packing.compress(block)
        crc = zlib.crc32(block, crc)
    return log(chunk(run()), bytes_of(Chunk("zstd", packed + packing.flush(), START_NS, START_NS, crc, mib << 20)))


def false_chunks() -> bytes:
    """Forms of chunks one in another, each of which has to be checked."""
    body = b""
    while len(body) < LIMIT_BYTES - 4000:
        head = struct.pack("<QQQIIQ", 0, 0, len(body), 5, 0, len(body))
        body = struct.pack("<BQ", 6, len(head) + len(body)) + head + body
    return log(chunk(run()), body)


def absurd_summary() -> bytes:
    most = (1 << 64) - 1
    counts = Statistics(
        attachment_count=1,
        channel_count=(1 << 32) - 1,
        channel_message_counts=dict.fromkeys(range(1000), most),
        chunk_count=(1 << 32) - 1,
        message_count=most,
        message_end_time=most,
        message_start_time=0,
        metadata_count=1,
        schema_count=1,
    )
    data = log(chunk(run()))
    summary = bytes_of(counts)
    footer = struct.pack("<BQQQ", 2, 20, len(data), 0)
    crc = zlib.crc32(footer, zlib.crc32(summary))
    return data + summary + bytes_of(Footer(0, len(data), crc)) + MCAP0_MAGIC


def many_channels() -> bytes:
    name = "/" + "x" * 300
    channels = [
        Channel(id=number, topic=f"{name}{number}", message_encoding="", metadata={}, schema_id=0)
        for number in range(100, 65_000)
    ]
    return log(chunk(run() + bytes_of(*channels)))


def yaml_bomb() -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
    return ROBOT_YAML + "\n".join(lines) + "\n"


def _calibration() -> Content:
    lens = [60, 0, 31.5, 0, 60, 23.5, 0, 0, 1]
    camera = CameraCalibration(width=64, height=48, distortion_model="plumb_bob", D=[0.0] * 5, K=lens)
    return "/camera/calibration", camera, START_NS


def _detected(tags: Sequence[TagDetection], at_ns: int) -> Content:
    found = TagDetections(stamp_ns=at_ns, width_px=64, height_px=48, detections=tags)
    return "/tags/detections", found, at_ns


def _rolled(index: int, step_m: float = 0.05) -> Content:
    """Odometry of a straight drive, ten times a second."""
    at_ns = START_NS + index * 100 * MS
    rolled = PlanarOdometry.WheelDistances(left_m=index * step_m, right_m=index * step_m)
    return "/odometry", PlanarOdometry(stamp_ns=at_ns, wheels=rolled), at_ns


def _observed(index: int, tags: Sequence[TagObservation]) -> Content:
    at_ns = START_NS + index * 100 * MS
    return "/tags/observations", TagObservations(stamp_ns=at_ns, frame="base", observations=tags), at_ns


def tags_seen(count: int, per_message: int) -> bytes:
    contents = [_calibration()]
    for index in range(0, count, per_message):
        at_ns = START_NS + index * MS
        tags = [TagDetection(family="tag36h11", tag_id=index + k, corners_px=_CORNERS_PX) for k in range(per_message)]
        contents.append(("/wheels", WheelEncoders(stamp_ns=at_ns, sequence=index, ticks_left=index), at_ns))
        contents.append(_detected(tags, at_ns))
    return of_messages(*contents)


def observe(
    count: int,
    n_tags: int | None = None,
    per_message: int = 2,
    step_m: float = 0.05,
    agree: bool = False,
    run_id: str = "r",
    size_bytes: int = 0,
    apart_m: float = 0.0,
) -> bytes:
    """A straight drive past tags that all seem to lie a metre ahead; after `n_tags` the first ones come again.

    Args:
        count: looks.
        n_tags: different ones; two new ones a look where None.
        per_message: tags a look.
        step_m: from look to look.
        agree: all tags lie at the start instead, so that observations of one fit together.
        run_id: of the run.
        size_bytes: to which it is padded.
        apart_m: how far each tag lies to the left of the one before.
    """
    contents: list[Content] = []
    for index in range(count):
        ids = [index * per_message + k if n_tags else index + k for k in range(per_message)]
        numbers = [each % n_tags if n_tags else each for each in ids]
        ahead_m = -index * step_m if agree else 1.0
        tags = [
            TagObservation(
                family="tag36h11",
                tag_id=number,
                cartesian=TagObservation.Cartesian(x_m=ahead_m, y_m=0.1 + apart_m * number),
            )
            for number in numbers
        ]
        contents += [_rolled(index, step_m), _observed(index, tags)]
    return of_messages(*contents, run_id=run_id, size_bytes=size_bytes)


def resets(wheel_segments: int, n_tags: int, looks: int = 2, size_bytes: int = 0) -> bytes:
    """A controller that restarts, and some looks at all tags in between; padded to `size_bytes`."""
    contents = [_calibration()]
    tags = [TagDetection(family="tag36h11", tag_id=k, corners_px=_CORNERS_PX) for k in range(n_tags)]
    for index in range(wheel_segments * looks):
        at_ns = START_NS + index * 100 * MS
        rolled = 100 * (index % looks)
        wheels = WheelEncoders(
            stamp_ns=at_ns, boot_id=index // looks, sequence=index, ticks_left=rolled, ticks_right=rolled
        )
        contents.append(("/wheels", wheels, at_ns))
        contents.append(_detected(tags, at_ns))
    return of_messages(*contents, size_bytes=size_bytes)


def observations_in_one_picture(count: int) -> bytes:
    """One look at a single tag, so many times in one message."""
    place = TagObservation.Cartesian(x_m=1.0, y_m=0.1)
    tags = [TagObservation(family="tag36h11", tag_id=1, cartesian=place)] * count
    return of_messages(*map(_rolled, range(4)), _observed(1, tags))


def honest() -> bytes:
    """No hostile one: a drive past five tags that stay where they are."""
    return observe(40, 5, step_m=0.041, agree=True, run_id="honest")


def drive(count: int) -> bytes:
    """Nothing but keyframes."""
    return of_messages(*map(_rolled, range(count)))


def pictures(encoded: Iterable[bytes], size_bytes: int = 0) -> bytes:
    contents: list[Content] = [("/wheels", WheelEncoders(stamp_ns=START_NS), START_NS)]
    for number, data in enumerate(encoded):
        contents.append(("/camera/image", CompressedImage(data=data, format="jpeg"), START_NS + number))
    return of_messages(*contents, size_bytes=size_bytes)


def huge_jpeg() -> bytes:
    data = bytearray(cv2.imencode(".jpg", np.zeros((64, 64), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = b"\xff\xff\xff\xff"
    return bytes(data)


def jpeg(picture: NDArray[np.uint8], n_bytes: int = 0) -> bytes:
    """A picture, stretched to a length by what no decoder looks at, but zstd packs well."""
    data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 20])[1].tobytes()
    return data[:-2] + bytes(max(0, n_bytes - len(data))) + data[-2:]


def squares(side: int, width: int = 8) -> NDArray[np.uint8]:
    """Nothing but squares, black or white at random; of the width of a JPEG's blocks, which take few bytes then."""
    few = np.random.default_rng(0).integers(0, 2, (side // width, side // width), dtype=np.uint8)
    return np.kron(255 * few, np.ones((width, width), np.uint8))


def noisy_png() -> bytes:
    """A piece of noise over and over: detectors find edges everywhere."""
    tiles = np.tile(squares(50, 1), (40, 40))
    return cv2.imencode(".png", tiles, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


def twins(count: int, copies: int) -> bytes:
    """Each look reads one tag at so many places at once."""
    contents: list[Content] = []
    for index in range(count):
        places = [TagObservation.Cartesian(x_m=1.0, y_m=k - 0.5 * copies) for k in range(copies)]
        tags = [TagObservation(family="tag36h11", tag_id=1, cartesian=place) for place in places]
        contents += [_rolled(index), _observed(index, tags)]
    return of_messages(*contents)


def png(side: int) -> bytes:
    return cv2.imencode(".png", np.zeros((side, side), np.uint8), [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


HOSTILE: dict[str, Callable[[], bytes]] = {
    "claimed lengths": claims,
    "one bomb of 60 MiB": lambda: bombs(60, 1),
    "one bomb of 1 GiB": lambda: giant_bomb(1024),
    "many bombs of 1 MiB": lambda: bombs(1, 1 << 20),
    "many bombs of 30 MiB": lambda: bombs(30, 1 << 20),
    "chunks in chunks": false_chunks,
    "absurd index": absurd_summary,
    "65 thousand channels": many_channels,
    "empty observations": lambda: full(lambda n: wheels(n, lambda _: WheelEncoders())),
    "observations, one a ns": lambda: full(lambda n: wheels(n, lambda k: observation(k, 1))),
    "observations, one a s": lambda: full(lambda n: wheels(n, lambda k: observation(k, 1000 * MS))),
    "a reset each observation": lambda: full(lambda n: wheels(n, lambda k: observation(k, 10 * MS, boot_id=k))),
    "extreme numbers": lambda: wheels(2000, extreme_observation),
    "YAML aliases": lambda: of_messages(robot_yaml=yaml_bomb()),
    "YAML of 1 MiB": lambda: of_messages(robot_yaml=ROBOT_YAML + "# x\n" * 250_000),
    "YAML list": lambda: of_messages(
        robot_yaml=ROBOT_YAML.replace("tags:", "tags: [" + "{default_size_m: 0.1}, " * 200_000 + "]\nother:")
    ),
    "YAML brackets": lambda: of_messages(robot_yaml="a: " + "[" * 900_000),
    "long calibration": lambda: of_messages(("/camera/calibration", CameraCalibration(K=[1.0] * 3_000_000), START_NS)),
    "tags in one picture": lambda: full(lambda n: tags_seen(n, n)),
    "a new tag in each picture": lambda: full(lambda n: tags_seen(n, 1)),
    "tags in a row": lambda: full(observe),
    "all tags in one picture": lambda: tags_seen(650, 650),
    "all tags in a row": lambda: observe(650),
    "all tags again and again": lambda: observe(2000, 650),
    "few tags all along": lambda: full(lambda n: observe(n, 50)),
    "a hundred tags a look": lambda: observe(2000, 600, 100),
    "a hundred tags a look that fit": lambda: observe(2000, 600, 100, step_m=0.041, agree=True),
    "twenty tags a look": lambda: full(lambda n: observe(n, 600, 20)),
    "tags a look, far apart": lambda: observe(2000, 600, 100, step_m=2.0),
    "few tags, far apart": lambda: full(lambda n: observe(n, 50, step_m=10.0)),
    "few tags that fit": lambda: full(lambda n: observe(n, 50, step_m=0.041, agree=True)),
    "a reset each look": lambda: resets(25, 400, size_bytes=1_010_000),
    "resets": lambda: resets(25, 10, 80, size_bytes=1_010_000),
    "resets, much seen": lambda: resets(25, 10, 530, size_bytes=1_010_000),
    "two segments past 400 tags": lambda: resets(2, 400),
    "three segments past 400 tags": lambda: resets(3, 400),
    "twelve segments past 400 tags": lambda: resets(12, 400),
    "segments past 100 tags": lambda: resets(13, 100, size_bytes=1_010_000),
    "one tag, much read in one picture": lambda: observations_in_one_picture(150_000),
    "keyframes": lambda: full(drive),
    "JPEG of 65535 x 65535": lambda: pictures([huge_jpeg()]),
    "PNGs of 5000 x 5000": lambda: pictures([png(5000)] * 10),
    "one tag in twenty places": lambda: twins(100, 20),
    "one tag in five places": lambda: full(lambda n: twins(n, 5)),
    "pictures of 8 x 8": lambda: full(lambda n: pictures([jpeg(squares(8))] * n)),
    "pictures of squares": lambda: full(lambda n: pictures([jpeg(squares(1000))] * n), 300),
    "as many squares as may be": lambda: pictures([jpeg(squares(1000))] * 145, size_bytes=1_010_000),
    "as much noise as may be": lambda: pictures([jpeg(squares(1000, 1))] * 25, size_bytes=1_010_000),
    "PNGs of noise as may be": lambda: pictures([noisy_png()] * 4, size_bytes=1_010_000),
    "PNG of 12000 x 12000": lambda: pictures([png(12000)]),
}
