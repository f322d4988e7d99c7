"""Draw skeletons as shaded bodies on a floor, in NumPy, with limbs coloured by error.

A limb is a row of spheres, and a depth buffer decides what is in front. The projection is parallel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from memmlp.motion.limb_shapes import HEAT, LIMBS, Limb, ends

NEUTRAL = (0.66, 0.70, 0.74)  # the truth's colour
SCALES = (10, 15, 20, 30, 40, 50, 75, 100)  # the possible tops of a colour scale, cm
SAMPLES = 2  # samples along a pixel's side, which are averaged for smooth edges
SPHERES = 18  # spheres of a limb
LIGHT = np.array([-0.45, 0.65, 0.62]) / np.linalg.norm([-0.45, 0.65, 0.62])  # to the light, camera's axes
AMBIENT = 0.46
ELEVATION = np.deg2rad(12)  # by which a camera looks down, radians
GRID = 0.5  # metres between the floor's lines
FLOOR = 0.56  # radius of the visible floor as a fraction of the picture's width
SHADOW = 0.13  # metres over which a shadow is blurred


def heat_colours(fractions: np.ndarray) -> np.ndarray:
    """Return colours (..., 3), 0 to 1, of errors (...) as fractions of the scale's top."""
    anchors = np.array([[int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)] for colour in HEAT])
    place = np.clip(fractions, 0, 1) * (len(anchors) - 1)
    return np.stack([np.interp(place, range(len(anchors)), channel) for channel in anchors.T], -1)


def colour_scale_top(errors: np.ndarray) -> float:
    """Return the top of a scale for errors in cm: the least of `SCALES` below which 98 % of them are."""
    high = float(np.percentile(errors, 98))
    return float(next((top for top in SCALES if high <= top), SCALES[-1]))


@dataclass(frozen=True)
class Camera:
    """A parallel projection of the world (Z up).

    Attributes:
        centre: the point (3,) in the middle of the picture, metres.
        azimuth: radians about the vertical; at 0 the camera looks along +Y.
        width, height: the picture's size, pixels.
        scale: pixels per metre.
        elevation: radians by which the camera looks down.
    """

    centre: np.ndarray
    azimuth: float
    width: int
    height: int
    scale: float
    elevation: float = ELEVATION

    @property
    def axes(self) -> np.ndarray:
        """Unit vectors as rows (3, 3): to the right, up, and towards the viewer."""
        (c, s), (ce, se) = ((np.cos(angle), np.sin(angle)) for angle in (self.azimuth, self.elevation))
        return np.array([[c, s, 0], [-s * se, c * se, ce], [s * ce, -c * ce, se]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project world points (..., 3) to metres (..., 3) from the centre: right, up, towards the viewer."""
        return (points - self.centre) @ self.axes.T

    def grid(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the metres to the right (1, W) and up (H, 1) of all samples, SAMPLES per pixel and axis."""
        width, height, scale = SAMPLES * self.width, SAMPLES * self.height, SAMPLES * self.scale
        right = (np.arange(width, dtype=np.float32) + 0.5 - width / 2) / scale
        up = (height / 2 - np.arange(height, dtype=np.float32) - 0.5) / scale
        return right[None], up[:, None]


def draw(camera: Camera, joints: np.ndarray, errors: np.ndarray | None, floor: float) -> np.ndarray:
    """Draw one skeleton on white, as a picture (height, width, 3), uint8.

    Args:
        camera: the projection.
        joints: positions (22, 3), metres, world.
        errors: the joints' errors (22,) as fractions of the colour scale's top; None for the truth.
        floor: the floor's height, metres.
    """
    right, up = camera.grid()
    picture = _draw_floor(camera, joints, floor)
    depth = np.full(picture.shape[:2], -np.inf, np.float32)
    for limb in LIMBS:
        _draw_limb(limb, camera, joints, errors, right, up, picture, depth)
    smooth = picture.reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3).mean((1, 3))
    return (smooth * 255 + 0.5).astype(np.uint8)


def _draw_floor(camera: Camera, joints: np.ndarray, floor: float) -> np.ndarray:
    """Draw the floor's grid and the skeleton's shadow on white: (H, W, 3) samples, 0 to 1.

    Both are smooth, so they are computed once for each pixel and repeated for its samples.
    """
    right, up = camera.grid()
    right, up = right[:, ::SAMPLES], up[::SAMPLES]
    axes = camera.axes.astype(np.float32)
    # World X and Y of the floor behind each pixel: how far towards the viewer its ray meets the floor.
    away = (floor - camera.centre[2] - right * axes[0, 2] - up * axes[1, 2]) / axes[2, 2]
    x, y = (
        (camera.centre[i] + right * axes[0, i] + up * axes[1, i] + away * axes[2, i]).astype(np.float32)
        for i in (0, 1)
    )
    # The floor has no horizon in a parallel projection: it fades out around the person instead.
    far = np.hypot(x - camera.centre[0], y - camera.centre[1]) / (FLOOR * camera.width / camera.scale)
    fade = np.clip(1.8 * (1 - far), 0, 1)
    lines = np.maximum(*(_grid_lines(along) for along in (x, y)))
    # The shadow is a soft spot under each end of a limb; where spots overlap, the darkest counts.
    shadow = np.zeros_like(fade)
    for px, py, pz in np.concatenate([ends(limb, joints) for limb in LIMBS]).tolist():
        spread = SHADOW + 0.25 * max(pz - floor, 0.0)  # higher up, wider and fainter
        near = ((x - px) ** 2 + (y - py) ** 2) / spread**2
        shadow = np.maximum(shadow, SHADOW / spread / (1 + near) ** 2)
    dark = fade * (0.05 + 0.13 * lines + 0.25 * shadow)
    return np.kron((1 - dark)[..., None], np.ones((SAMPLES, SAMPLES, 3), np.float32))


def _grid_lines(along: np.ndarray) -> np.ndarray:
    """Return the fraction (height, width) of each pixel on the grid lines of a floor coordinate, metres."""
    off = np.abs((along / GRID + 0.5) % 1 - 0.5) * GRID
    pixel = np.hypot(*np.gradient(along))  # metres of the floor that a pixel covers
    return np.clip(1.2 - off / np.maximum(pixel, 1e-6), 0, 1)


def _draw_limb(
    limb: Limb,
    camera: Camera,
    joints: np.ndarray,
    errors: np.ndarray | None,
    right: np.ndarray,
    up: np.ndarray,
    picture: np.ndarray,
    depth: np.ndarray,
) -> None:
    """Draw a limb into a picture (H, W, 3), in place, wherever it is nearer than the depth buffer (H, W).

    Metres to the `right` (1, W) and `up` (H, 1) are those of `Camera.grid`.
    """
    a, b = (camera.project(point).astype(np.float32) for point in ends(limb, joints))
    part = np.linspace(0, 1, SPHERES, dtype=np.float32)[:, None, None]
    # The axes are (sphere, row, column). Only the rectangle of samples that the limb can cover is computed.
    centre = [a[i] + part * (b[i] - a[i]) for i in range(3)]
    radius = limb.radii[0] + part * (limb.radii[1] - limb.radii[0])
    columns = slice(*np.searchsorted(right[0], [(centre[0] - radius).min(), (centre[0] + radius).max()]))
    rows = slice(*np.searchsorted(-up[:, 0], [(-centre[1] - radius).min(), (-centre[1] + radius).max()]))
    x, y = right[:, columns] - centre[0], up[rows] - centre[1]
    inside = radius**2 - x**2 - y**2
    # A sphere's surface towards the viewer; the nearest sphere at each sample is visible.
    surface = np.where(inside > 0, centre[2] + np.sqrt(np.maximum(inside, 0)), -np.inf)
    best = surface.argmax(0)[None]
    near = np.take_along_axis(surface, best, 0)[0]
    visible = near > depth[rows, columns]
    # How far along the limb that sphere is, for the colour, and its normal there, for the light.
    t = part[best[0], 0, 0]
    normal = np.stack(
        [np.take_along_axis(v, best, 0)[0] / radius[best[0], 0, 0] for v in np.broadcast_arrays(x, y)], -1
    )
    normal = np.concatenate([normal, np.sqrt(np.clip(1 - (normal**2).sum(-1, keepdims=True), 0, 1))], -1)
    # On the side, the normals are those of a smooth tube, which hides the bumps between the spheres.
    axis = (b - a) / max(float(np.linalg.norm(b - a)), 1e-6)
    flat = normal - (normal @ axis)[..., None] * axis
    flat /= np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-6)
    normal = np.where(((t > 0) & (t < 1))[..., None], flat, normal)
    # Diffuse light from LIGHT, and a little more where the surface faces the viewer.
    light = AMBIENT + (1 - AMBIENT) * np.clip(normal @ LIGHT, 0, 1) + 0.12 * normal[..., 2] - 0.06
    colour = np.array(NEUTRAL)
    if errors is not None:
        colour = heat_colours(np.interp(t, (0, 1), errors[[limb.first, limb.end]]))
    picture[rows, columns][visible] = np.clip(colour * light[..., None], 0, 1)[visible]
    depth[rows, columns][visible] = near[visible]
