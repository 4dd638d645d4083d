"""Definitions of messages that are no part of ROS, for bags that do not carry them (ROS 2's older .db3 files).

Fields and types after the public interfaces of github.com/christianrauch/apriltag_msgs and
github.com/NVIDIA-ISAAC-ROS/isaac_ros_common (isaac_ros_apriltag_interfaces).
"""

from typing import Final

# By package, then by type.
DEFINITIONS: Final = {
    "apriltag_msgs": {
        "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
        "apriltag_msgs/msg/AprilTagDetection": (
            "string family\n"
            "int32 id\n"
            "int32 hamming\n"
            "float32 goodness\n"
            "float32 decision_margin\n"
            "apriltag_msgs/Point centre\n"
            "apriltag_msgs/Point[4] corners\n"
            "float64[9] homography\n"
        ),
        "apriltag_msgs/msg/AprilTagDetectionArray": (
            "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections\n"
        ),
    },
    "isaac_ros_apriltag_interfaces": {
        "isaac_ros_apriltag_interfaces/msg/AprilTagDetection": (
            "string family\n"
            "int32 id\n"
            "geometry_msgs/Point center\n"
            "geometry_msgs/Point[4] corners\n"
            "geometry_msgs/PoseWithCovarianceStamped pose\n"
        ),
        "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray": (
            "std_msgs/Header header\nisaac_ros_apriltag_interfaces/AprilTagDetection[] detections\n"
        ),
    },
}
