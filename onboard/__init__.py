"""Programs on the robot's computer: they read wheels and camera, detect tags and write a run log."""

import os

# OpenCV reads this when it is imported. With its default a stalled camera would block for ten seconds.
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")
