"""Two looks with the tool turned in between separate shifts of the object from shifts of the camera."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from i2t.collect.camera_offset import lateral_offset, matching_shifts

PIXEL, TOLERANCE = (0.75e-3, 0.75e-3), 6e-3
ROWS, COLUMNS = np.indices((90, 100))
TABLE = 0.12 + 2e-4 * COLUMNS  # m, seen at a tilt
AROUND = (slice(30, 60), slice(35, 65))
RANDOM = np.random.default_rng(0)


def _seen(block):
    """Depth of the table with a block 20 mm high on it, which covers the given rows and columns."""
    depth = TABLE.copy()
    depth[block] -= 20e-3
    return depth


def _matching(depth, expected, around=AROUND, pixel=PIXEL):
    on_object = np.zeros(depth.shape, bool)
    on_object[around] = True
    return matching_shifts(depth, expected, on_object, pixel, TOLERANCE)


@pytest.mark.parametrize(("u", "v", "nearer"), [(0, 0, 0.0), (9, -4, 0.0), (-5, 7, 2e-3), (-16, 16, 0.0)])
def test_a_shifted_view_is_found_within_half_a_pixel_along_a_tilted_table(u, v, nearer):
    block = tuple(slice(part.start + by, part.stop + by) for part, by in zip(AROUND, (v, u), strict=True))
    depth = _seen(block) - nearer + 0.3e-3 * RANDOM.standard_normal(TABLE.shape)
    depth[10:20] = np.nan  # a hole
    shifts = _matching(depth, _seen(AROUND))
    np.testing.assert_allclose(shifts.mean(0)[:2], 0.75e-3 * np.array([u, v]), atol=0.5 * 0.75e-3)
    np.testing.assert_allclose(shifts[0, :2], 0.75e-3 * np.array([u, v]), atol=1e-9)
    # The block stays on the table: what shifts it across the view shifts it along too.
    assert shifts[0, 2] == pytest.approx(2e-4 * u - nearer, abs=1e-4)


def test_a_plane_determines_no_shift_and_an_edge_one_direction():
    every = _matching(TABLE, TABLE)
    assert len(every) == 33**2
    along_v = _matching(_seen((slice(None), slice(37, 67))), _seen((slice(None), slice(35, 65))))
    assert len(along_v) == 33
    np.testing.assert_allclose(along_v[:, 0], 1.5e-3)
    assert len(_matching(np.full_like(TABLE, np.nan), _seen(AROUND))) == 33**2
    assert len(_matching(TABLE[:20, :20], TABLE[:20, :20], (slice(5, 9), slice(5, 9)))) == 33**2  # no room for shifts


def test_a_finer_view_is_shifted_in_as_many_steps():
    shifts = _matching(_seen((slice(30, 60), slice(44, 74))), _seen(AROUND), pixel=(0.4e-3, 0.4e-3))
    np.testing.assert_allclose(shifts.mean(0)[:2], [3.6e-3, 0.0], atol=0.4e-3)


@pytest.mark.parametrize("degrees", [180, 120, -90])
def test_an_offset_that_turns_with_the_tool_is_the_camera_s(degrees):
    first = Rotation.from_euler("xyz", [170, 8, 40], degrees=True)
    turned = first * Rotation.from_euler("z", degrees, degrees=True)
    moved, aside = np.array([4e-3, -2e-3, 1e-3]), np.array([5e-3, -3e-3, 0.0])
    shifts = [(moved - pose.apply(aside))[None] for pose in (first, turned)]
    along, offset, uncertainty = lateral_offset(*shifts, (first.as_matrix(), turned.as_matrix()))
    np.testing.assert_allclose(offset, along @ aside[:2], atol=1e-12)
    np.testing.assert_allclose(uncertainty, 0.0, atol=1e-12)
