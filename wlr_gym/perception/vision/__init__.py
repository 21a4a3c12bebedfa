"""Vision: pose and slip of the robot from ring markers in a video, as run columns and a slip table: ``docs/vision.md``.

Needs OpenCV (``pip install wlr-gym[vision]``) once a picture is read.
"""
