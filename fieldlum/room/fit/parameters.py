"""Define the numbers of a scene that a search changes, with their steps and priors."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Room
from fieldlum.room.fit.guess import Guess, is_outside
from fieldlum.room.scene.box_room import FROM_HIGH_END, WALLS

# Standard deviations of values measured with a tape measure and a compass (docs/scene.md).
NORTH_SD_DEG, CLOCK_SD_MIN, LEVEL_SD_DEG = 2.0, 5.0, 0.3
LENGTH_SD_SHARE, EDGE_SD_M, CAMERA_SD_M, THICKNESS_SD_M = 0.02, 0.05, 0.05, 0.05
GLASS_SD = 0.2  # chosen: tinted and coated panes have 0.3 to 0.7, and look clear
POSE_NAMES = ("north_deg", "tilt_deg", "roll_deg", "clock_min")
CLOCK_REACH_MIN = 19.0  # of the table of suns in `evidence`
# First steps of the search, chosen: m of the room, degrees, m of a solid inside and outside.
_STEP_M, _STEP_DEG, _SOLID_STEP_M, _OUTSIDE_STEP_M = 0.04, 0.5, 0.16, 0.5


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of the scene that a search changes, in m, degrees, minutes or, for an albedo, 1.

    name: for results, such as "width_m" or "window 1 u_m0". path: attributes and indices that lead
    from a guess to the number, such as ("size_m", 0); step: by which a search changes it at first;
    sd: standard deviation of its prior, inf without one; minimum, maximum: limits.
    """

    name: str
    path: tuple[str | int, ...]
    step: float
    sd: float = np.inf
    minimum: float = -np.inf
    maximum: float = np.inf

    def read(self, guess: Guess) -> float:
        """Return the value in a guess, in the parameter's unit."""
        value: Any = guess
        for key in self.path:
            value = value[key] if isinstance(key, int) else getattr(value, key)
        return value

    def measured(self, guess: Guess) -> float:
        """Return the value as a tape measures it, in the parameter's unit.

        Unlike in a guess, both ends of any window's `u_m` count from its wall's left end, as seen
        from inside.
        """
        value = self.read(guess)
        if self.path[0] == "windows" and self.path[2] == "u_m":
            wall = guess.windows[int(self.path[1])].wall
            return guess.size_m[1 - WALLS[wall][0]] - value if wall in FROM_HIGH_END else value
        return value

    def change(self, guess: Guess, by: float) -> Guess:
        """Return the guess with `by` added to the number, as far as its limits allow."""
        value = float(np.clip(self.read(guess) + by, self.minimum, self.maximum))
        return _with(guess, self.path, value)


def _with(record: Any, path: tuple[str | int, ...], value: float) -> Any:
    """Return a record or tuple with the number at the end of `path` replaced."""
    if not path:
        return value
    key, rest = path[0], path[1:]
    if isinstance(key, int):
        return (*record[:key], _with(record[key], rest, value), *record[key + 1 :])
    return replace(record, **{key: _with(getattr(record, key), rest, value)})


def room_parameters(guess: Guess, clock_sd_min: float = CLOCK_SD_MIN) -> list[Parameter]:
    """Return a guess's parameters: pose, clock, sizes, camera, wall thickness and window edges.

    Pose is north, tilt and roll; sizes are width and depth; camera is its x and y. clock_sd_min:
    standard deviation of the clock's prior, in minutes. The camera's height is not a parameter: it
    sets the scale of all lengths. Nor is the room's height.
    """
    reach = CLOCK_REACH_MIN
    width_sd_m, depth_sd_m, _ = (max(LENGTH_SD_SHARE * side, 0.03) for side in guess.size_m)
    return [
        Parameter("north_deg", ("north_deg",), _STEP_DEG, sd=NORTH_SD_DEG),
        Parameter("clock_min", ("clock_min",), 2.0, sd=clock_sd_min, minimum=-reach, maximum=reach),
        Parameter("tilt_deg", ("tilt_deg",), _STEP_DEG / 2.0, sd=LEVEL_SD_DEG),
        Parameter("roll_deg", ("roll_deg",), _STEP_DEG / 2.0, sd=LEVEL_SD_DEG),
        Parameter("wall_azimuth_deg", ("wall_azimuth_deg",), _STEP_DEG, sd=NORTH_SD_DEG),
        Parameter("width_m", ("size_m", 0), _STEP_M, sd=width_sd_m),
        Parameter("depth_m", ("size_m", 1), _STEP_M, sd=depth_sd_m),
        Parameter("camera_x_m", ("camera_m", 0), _STEP_M, sd=CAMERA_SD_M),
        Parameter("camera_y_m", ("camera_m", 1), _STEP_M, sd=CAMERA_SD_M),
        Parameter("thickness_m", ("thickness_m",), _STEP_M, sd=THICKNESS_SD_M, minimum=0.01),
        *(
            Parameter(
                f"window {k + 1} {span[0]}{end}", ("windows", k, span, end), _STEP_M, sd=EDGE_SD_M
            )
            for k in range(len(guess.windows))
            for span in ("u_m", "z_m")
            for end in (0, 1)
        ),
    ]


def glass_parameters(guess: Guess) -> list[Parameter]:
    """Return the transmittances of several windows as parameters, an empty list for one window.

    That of a single window cannot be separated from the albedos.
    """
    several = len(guess.windows) if len(guess.windows) > 1 else 0
    limits = {"minimum": 0.05, "maximum": 0.92}
    return [
        Parameter(f"window {k + 1} glass", ("windows", k, "transmittance"), 0.1, GLASS_SD, **limits)
        for k in range(several)
    ]


def bar_parameters(number: int) -> list[Parameter]:
    """Return both edges and the outer face of a bar as parameters, m.

    number: index of the bar in `Guess.bars`.
    """
    ends = (("low", "span_m", 0), ("high", "span_m", 1), ("out", "depth_m", 1))
    return [
        Parameter(f"bar {number + 1} {label}", ("bars", number, span, end), _STEP_M / 2.0)
        for label, span, end in ends
    ]


def solid_parameters(guess: Guess, number: int) -> list[Parameter]:
    """Return the faces of a solid as parameters, m, and the albedo of one inside.

    number: index of the solid in `guess.solids`. The lower face is a parameter only if it is above
    the floor. No patch depends on an albedo outside. A solid outside cannot move inside.
    """
    solid = guess.solids[number]
    outside = is_outside(guess, solid)
    step = _OUTSIDE_STEP_M if outside else _SOLID_STEP_M
    faces, name = [], f"solid {number + 1}"
    for axis, corner in product(range(3), ("low_m", "high_m")):
        if axis == 2 and corner == "low_m" and solid.low_m[2] <= 0.0:
            continue
        minimum, maximum = -np.inf, np.inf
        if axis < 2 and corner == "low_m" and solid.low_m[axis] >= guess.size_m[axis]:
            minimum = guess.size_m[axis]
        if axis < 2 and corner == "high_m" and solid.high_m[axis] <= 0.0:
            maximum = 0.0
        label, path = f"{name} {corner[0]}{'xyz'[axis]}", ("solids", number, corner, axis)
        faces.append(Parameter(label, path, step, minimum=minimum, maximum=maximum))
    path = ("solids", number, "albedo")
    albedo = Parameter(f"{name} albedo", path, 0.1, minimum=0.03, maximum=0.9)
    return faces if outside else [*faces, albedo]


def all_parameters(guess: Guess, of_room: list[Parameter]) -> list[Parameter]:
    """Return `of_room`, those of the room itself, and the parameters of all bars and solids."""
    bars = [p for k in range(len(guess.bars)) for p in bar_parameters(k)]
    solids = [p for k in range(len(guess.solids)) for p in solid_parameters(guess, k)]
    return [*of_room, *bars, *solids]


def stated_albedo(room: Room) -> Floats:
    """Return the stated albedos of west, east, south and north wall, floor and ceiling, [6]."""
    walls = [room.reflectance_walls] * 4
    return np.array([*walls, room.reflectance_floor, room.reflectance_ceiling])
