"""Where a picture is taken from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array, cross, unit


@dataclass(frozen=True)
class Camera:
    """A pinhole: square pixels, rows from the top."""

    eye_mm: Array  # (3,)
    target_mm: Array  # (3,) what is in the middle of the picture
    up: Array  # (3,) what shows upwards, not along the view
    field_of_view_deg: float  # from the left to the right side
    width: int  # pixels
    height: int

    def rays(self) -> Array:
        """(4, 3): eye, the direction of the picture's upper left corner, and the step to the next pixel and row.

        The ray of pixel (row, column) goes from the eye along corner + (column + 1/2) · right + (row + 1/2) · down.
        Raises ValueError when ``up`` lies along the view.
        """
        forward = unit(self.target_mm - self.eye_mm)
        right = unit(cross(forward, np.asarray(self.up, dtype=np.float64)))
        down = cross(forward, right)
        pixel = 2.0 * np.tan(0.5 * np.radians(self.field_of_view_deg)) / self.width
        corner = forward - 0.5 * pixel * (self.width * right + self.height * down)
        return np.stack([self.eye_mm, corner, pixel * right, pixel * down])
