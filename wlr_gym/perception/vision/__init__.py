"""Vision: pose and slip of the robot from ring markers in a video, as run columns and a slip table: ``docs/vision.md``.

Needs OpenCV (``pip install wlr-gym[vision]``) once a picture is read.
"""

from wlr_gym.perception.markers.camera import load_camera
from wlr_gym.perception.markers.targets import load_target
from wlr_gym.perception.vision.analysis import VideoAnalysis, analyse, save_video_analysis
from wlr_gym.perception.vision.video import Frames

__all__ = ["Frames", "VideoAnalysis", "analyse", "load_camera", "load_target", "save_video_analysis"]
