"""Vision: pose and slip of the robot from ring markers in a video. How to use it: ``docs/vision.md``.

``load_camera``, ``load_target``, ``Frames`` and ``analyse`` take a video to run columns and a slip table; ``detect``,
``find_target`` and ``Tracker`` are the steps in between.
"""

from wlr_gym.base.errors import require_package

require_package("cv2", "vision")

from wlr_gym.perception.markers.camera import Camera, calibrate, load_camera, save_camera  # noqa: E402
from wlr_gym.perception.markers.detect import Detection, detect  # noqa: E402
from wlr_gym.perception.markers.pose import TargetPose, find_target  # noqa: E402
from wlr_gym.perception.markers.targets import Marker, Target, load_target  # noqa: E402
from wlr_gym.perception.vision.align import Alignment, align  # noqa: E402
from wlr_gym.perception.vision.analyse import Analysis, analyse, save  # noqa: E402
from wlr_gym.perception.vision.live import film  # noqa: E402
from wlr_gym.perception.vision.paper import paper_pose  # noqa: E402
from wlr_gym.perception.vision.slip import SlipResult, measure_slip  # noqa: E402
from wlr_gym.perception.vision.track import Frame, Sample, Tracker, locate_floor, track  # noqa: E402
from wlr_gym.perception.vision.video import Frames  # noqa: E402

__all__ = [
    "Alignment",
    "Analysis",
    "Camera",
    "Detection",
    "Frame",
    "Frames",
    "Marker",
    "Sample",
    "SlipResult",
    "Target",
    "TargetPose",
    "Tracker",
    "align",
    "analyse",
    "calibrate",
    "detect",
    "film",
    "find_target",
    "load_camera",
    "load_target",
    "locate_floor",
    "measure_slip",
    "paper_pose",
    "save",
    "save_camera",
    "track",
]
