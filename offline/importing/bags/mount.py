"""Camera mount of a bag: from its fixed transforms, unless the command line or robot.yaml define it."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import degrees, radians
from pathlib import Path
from typing import Final

from groundsbot.calib.robot import Mount
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.frames import FixedFrames, frame_name, mount_of
from groundsbot.offline.importing.bags.topics import BagOptions
from groundsbot.offline.importing.robot import ImportOptions

# ROS's names for the base, in the order of preference, where the odometry names none.
_BASES: Final = ("base_link", "base_footprint")
# With a steeper pitch than this, the frame is more likely not the optical one.
_STEEP_RAD: Final = radians(60.0)


@dataclass(frozen=True)
class BagMount:
    """Pose of the camera on its robot.

    Attributes:
        mount: mount from tf; None if it comes from elsewhere.
        in_camera: whether detections are relative to the camera; else to the base.
        remarks: lines for the user.
    """

    mount: Mount | None
    in_camera: bool
    remarks: tuple[str, ...]


def find_mount(
    path: Path,
    frames: FixedFrames,
    base_of_odometry: str,
    camera_frames: Iterable[str],
    options: ImportOptions,
    bag_options: BagOptions,
) -> BagMount:
    """Return the mount from the transforms between the camera's frame and the base's.

    Args:
        path: names the bag in errors.
        frames: frames of the bag.
        base_of_odometry: child frame of the odometry; may be empty.
        camera_frames: frames of detections or pictures.
        options: options of the command line.
        bag_options: options of the command line.

    Raises:
        OfflineError: there are several cameras, or tf does not connect the frames.
    """
    camera = _camera_frame(path, set(camera_frames), bag_options)
    base = _base_frame(frames, base_of_odometry, bag_options)
    if camera == base:
        return BagMount(None, False, (f"tags are observed in {base!r}, so no mount is needed",))
    if options.robot is not None:
        return BagMount(None, True, ())
    if not frames.are_connected(base, camera):
        if options.has_mount:
            return BagMount(
                None, True, (f"tf does not connect {camera!r} to {base!r}; roll and pitch are 0 where not given",)
            )
        moving = [each for each in (frames.moving_root(camera), frames.moving_root(base)) if each is not None]
        why = f", since {moving[0]!r} moves on its parent" if moving else ""
        raise OfflineError(
            f"{path}: no fixed transforms connect the camera's frame {camera!r} to the base {base!r}{why}; record "
            "/tf_static, or name frames with --camera-frame and --base-frame, or give --camera-x-m, --camera-y-m and "
            "--camera-yaw-deg, or --robot"
        )
    mount = mount_of(frames.transform(base, camera))
    remarks = [f"tf from {base!r} to {camera!r} gives the camera mount"]
    if abs(mount.pitch_rad) > _STEEP_RAD:
        steep = f"the camera's frame {camera!r} looks {abs(degrees(mount.pitch_rad)):.0f} deg"
        remarks.append(f"{steep} {'down' if mount.pitch_rad > 0 else 'up'}; is it the optical one? see --camera-frame")
    return BagMount(mount, True, tuple(remarks))


def _camera_frame(path: Path, named: set[str], options: BagOptions) -> str:
    if options.camera_frame is not None:
        return frame_name(options.camera_frame)
    if len(named) > 1:
        raise OfflineError(
            f"{path}: detections come from {len(named)} frames, {', '.join(sorted(named))}, but a run has one camera; "
            "import a topic of one camera, or give --camera-frame if all are the same"
        )
    return next(iter(named), "")


def _base_frame(frames: FixedFrames, of_odometry: str, options: BagOptions) -> str:
    if options.base_frame is not None:
        return frame_name(options.base_frame)
    if of_odometry:
        return frame_name(of_odometry)
    return next((each for each in _BASES if frames.has(each)), _BASES[0])
