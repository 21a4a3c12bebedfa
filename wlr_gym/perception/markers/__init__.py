"""Ring markers in one picture: targets, camera, detection and pose. Needs OpenCV where a picture is read."""
