"""Films of a calibration board with a rolling shutter, drawn row by row by plane geometry of their own."""

import math

import numpy as np

from wlr_gym.perception.markers.calibration import CHESSBOARD, Board
from wlr_gym.perception.markers.camera import Camera
from wlr_gym.perception.vision.tracking import VideoFrame

#: px per m of the board's picture; m of white around it.
_FINE, _MARGIN = 4000.0, 0.02


def board_picture(board: Board) -> np.ndarray:
    """The printed board with a white margin."""
    width, height = round(board.columns * board.square * _FINE), round(board.rows * board.square * _FINE)
    if board.kind == CHESSBOARD:
        y, x = np.mgrid[0:height, 0:width] // round(board.square * _FINE)
        print_ = np.where((x + y) % 2, 255, 0).astype(np.uint8)
    else:
        print_ = board.aruco().generateImage((width, height), marginSize=0, borderBits=1)
    return np.pad(print_, round(_MARGIN * _FINE), constant_values=255)


def motion(t: np.ndarray, speed: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) and rotations (T, 3, 3) of the board's corner, that wander all over the image."""
    from scipy.spatial.transform import Rotation

    phase = np.random.default_rng(seed).uniform(0, 2 * math.pi, 6)
    pace = speed * np.array([2.6, 3.7, 1.9, 2.3, 3.1, 1.3])
    wave = np.sin(t[:, None] * pace + phase)
    places = np.array([-0.11, -0.08, 0.42]) + [0.1, 0.08, 0.06] * wave[:, :3]
    return places, Rotation.from_rotvec([0.45, 0.45, 0.3] * wave[:, 3:]).as_matrix()


def board_film(
    board: Board,
    camera: Camera,
    readout: float,
    count: int,
    rate: float = 30.0,
    speed: float = 1.0,
    noise: float = 2.0,
    seed: int = 0,
):
    """Yield the frames; the middle row shows a frame's time. The lens has no distortion."""
    import cv2

    picture, rng = board_picture(board), np.random.default_rng(seed)
    rows = (np.arange(camera.height) / camera.height - 0.5) * readout
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    rays = np.stack(
        [(u - camera.centre[0]) / camera.focal[0], (v - camera.centre[1]) / camera.focal[1], np.ones_like(u)], axis=-1
    )
    for index in range(count):
        places, turns = motion(index / rate + rows, speed, seed)
        depth = np.einsum("vi,vi->v", turns[:, :, 2], places)[:, None] / np.einsum("vui,vi->vu", rays, turns[:, :, 2])
        on_board = np.einsum("vji,vuj->vui", turns, depth[..., None] * rays - places[:, None])
        x, y = (((on_board[..., k] + _MARGIN) * _FINE - 0.5).astype(np.float32) for k in range(2))
        image = cv2.remap(
            cv2.GaussianBlur(picture, (0, 0), 2.5), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=128
        )
        spoilt = cv2.GaussianBlur(image.astype(float), (0, 0), 0.7) + noise * rng.standard_normal(image.shape)
        yield VideoFrame(index, index / rate, np.clip(np.rint(spoilt), 0, 255).astype(np.uint8))
