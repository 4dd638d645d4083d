"""`groundsbot-offline import`: its options, and the choice of the importer."""

from pathlib import Path
from typing import Annotated, Final

import typer

from groundsbot.offline.commands.drives import WorkerCount
from groundsbot.offline.commands.terminal import echo_lines

# Groups of options in the help.
_ROBOT: Final = "Robot and camera"
_RECORDING: Final = "What to read of the recording"
OutputFolder = Annotated[Path, typer.Option("-o", "--output", help="Folder of runs; made if missing.", metavar="DIR")]


def import_recording(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING...",
            help="Folder with odometry.csv + observations.csv, or odom.csv + landmarks.csv; ROS bag; or .wpilog.",
        ),
    ],
    output: OutputFolder,
    run_id: Annotated[str | None, typer.Option(help="Name of the run. [default: the recording's]")] = None,
    robot_id: Annotated[str | None, typer.Option(help="Name of the robot. [default: the recording's]")] = None,
    robot: Annotated[
        Path | None, typer.Option(help="robot.yaml with wheels and mount; options override it.", rich_help_panel=_ROBOT)
    ] = None,
    track_width_m: Annotated[
        float | None, typer.Option(help="Distance between the wheels.", rich_help_panel=_ROBOT)
    ] = None,
    wheelbase_m: Annotated[
        float | None,
        typer.Option(help="From the rear axle to the front one, for steering_rad.", rich_help_panel=_ROBOT),
    ] = None,
    state_rate_hz: Annotated[
        float | None,
        typer.Option(help="Rows per second, for odom.csv, which has no times.", rich_help_panel=_RECORDING),
    ] = None,
    wheel_radius_m: Annotated[
        float | None, typer.Option(help="Radius of both wheels, for ticks and joints.", rich_help_panel=_ROBOT)
    ] = None,
    ticks_per_turn: Annotated[
        float | None, typer.Option(help="Ticks in one turn of a wheel.", rich_help_panel=_ROBOT)
    ] = None,
    camera_x_m: Annotated[
        float | None, typer.Option(help="Camera ahead of the wheels' midpoint. [default: 0]", rich_help_panel=_ROBOT)
    ] = None,
    camera_y_m: Annotated[
        float | None, typer.Option(help="Camera left of the wheels' midpoint. [default: 0]", rich_help_panel=_ROBOT)
    ] = None,
    camera_yaw_deg: Annotated[
        float | None, typer.Option(help="Camera yaw, positive to the left. [default: 0]", rich_help_panel=_ROBOT)
    ] = None,
    camera_z_m: Annotated[
        float | None, typer.Option(help="Bag, wpilog: camera above the floor.", rich_help_panel=_ROBOT)
    ] = None,
    camera_roll_deg: Annotated[
        float | None,
        typer.Option(help="Bag, wpilog: camera roll, positive: its top tips to the right.", rich_help_panel=_ROBOT),
    ] = None,
    camera_pitch_deg: Annotated[
        float | None, typer.Option(help="Bag, wpilog: camera pitch, positive: it looks down.", rich_help_panel=_ROBOT)
    ] = None,
    swerve_modules_m: Annotated[
        str | None,
        typer.Option(
            help="Wpilog: places of the swerve modules, 'x,y x,y ...', in the log's order.", rich_help_panel=_ROBOT
        ),
    ] = None,
    tag_family: Annotated[str, typer.Option(help="Family of the tags.")] = "tag36h11",
    tag_size_m: Annotated[
        float | None,
        typer.Option(
            help="Bag, wpilog: side of the tags' black square (outer edge), to compute positions from corners."
        ),
    ] = None,
    odometry_topic: Annotated[
        str | None, typer.Option(help="Bag, wpilog: topic of the odometry.", rich_help_panel=_RECORDING)
    ] = None,
    tags_topic: Annotated[
        str | None, typer.Option(help="Bag, wpilog: topic of AprilTag detections.", rich_help_panel=_RECORDING)
    ] = None,
    image_topic: Annotated[
        str | None, typer.Option(help="Bag: topic of pictures, to detect tags in.", rich_help_panel=_RECORDING)
    ] = None,
    camera_info_topic: Annotated[
        str | None, typer.Option(help="Bag: topic of the camera's calibration.", rich_help_panel=_RECORDING)
    ] = None,
    imu_topic: Annotated[
        str | None,
        typer.Option(
            help="Bag, wpilog: topic of a gyro that the odometry does not contain.", rich_help_panel=_RECORDING
        ),
    ] = None,
    left_joint: Annotated[
        str | None, typer.Option(help="Bag: the left wheel's joint, in JointState.", rich_help_panel=_RECORDING)
    ] = None,
    right_joint: Annotated[
        str | None, typer.Option(help="Bag: the right wheel's joint.", rich_help_panel=_RECORDING)
    ] = None,
    base_frame: Annotated[
        str | None, typer.Option(help="Bag: base frame. [default: the odometry's child]", rich_help_panel=_RECORDING)
    ] = None,
    camera_frame: Annotated[
        str | None,
        typer.Option(help="Bag: optical frame of the camera. [default: in headers]", rich_help_panel=_RECORDING),
    ] = None,
    receive_times: Annotated[
        bool,
        typer.Option(
            "--receive-times", help="Bag: use times of reception, not those in headers.", rich_help_panel=_RECORDING
        ),
    ] = False,
    workers: WorkerCount = None,
) -> None:
    """Make a run log, DIR/RUN_ID/0000.core.mcap, from CSV files, a ROS bag or a WPILib log (docs/formats.md).

    Of several recordings each becomes a run; options hold for all of them. If one cannot be imported, none is.

    CSV: observations in observations.csv are in the sensor's frame; with --robot and no --camera option they are in the
    robot's base frame. Those in landmarks.csv are in the camera's. Bags, of ROS 1 or ROS 2, and logs of FRC robots:
    topics are found by type.
    """
    from groundsbot.offline.commands.import_recordings import ImportChoices, import_recordings
    from groundsbot.offline.importing import BagOptions, ImportOptions

    options = ImportOptions(
        run_id=run_id,
        robot_id=robot_id,
        robot=robot,
        track_width_m=track_width_m,
        wheelbase_m=wheelbase_m,
        state_rate_hz=state_rate_hz,
        wheel_radius_m=wheel_radius_m,
        ticks_per_turn=ticks_per_turn,
        camera_x_m=camera_x_m,
        camera_y_m=camera_y_m,
        camera_yaw_deg=camera_yaw_deg,
        camera_z_m=camera_z_m,
        camera_roll_deg=camera_roll_deg,
        camera_pitch_deg=camera_pitch_deg,
        tag_family=tag_family,
    )
    of_bags = BagOptions(
        odometry_topic=odometry_topic,
        tags_topic=tags_topic,
        image_topic=image_topic,
        camera_info_topic=camera_info_topic,
        imu_topic=imu_topic,
        left_joint=left_joint,
        right_joint=right_joint,
        base_frame=base_frame,
        camera_frame=camera_frame,
        tag_size_m=tag_size_m,
        receive_times=receive_times,
    )
    choices = ImportChoices(options, of_bags, swerve_modules_m)
    for report in import_recordings(recordings, output, choices, workers):
        echo_lines(report.lines())
