"""What runs on the robot's computer: reads wheels and camera, detects tags, writes a run log."""

import os

# OpenCV reads this once, as it is imported: otherwise a stalled camera would block for ten seconds.
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")
