"""Dimensions of depth patches and skins. This module imports nothing, so that code without arrays can use it."""

PATCH_PIXELS = 48  # number of pixels along each edge of a depth patch
PATCH_WINDOW = 17e-3  # m, edge of a depth patch: the square that the paper crops around the tool axis
VIEW_PIXELS = 72  # number of pixels along each edge of a view, which is a patch with its surroundings
VIEW_WINDOW = PATCH_WINDOW * VIEW_PIXELS / PATCH_PIXELS  # m, edge of a view with the patch's pixel size (25.5 mm)
TWIST_LEVER_M = PATCH_WINDOW / 2  # m, lever that turns the rotation of a twist into a length
REACH = 4e-3  # m, depth behind a patch's nearest surface point at which the depths of the patch are clipped
STANDOFF = 40e-3  # m, distance behind the tool's origin at which rays of a rendered patch start
PAD_WINDOW = 20e-3  # m, edge of the skin's square face
MAX_SKIN_FORCE_N = 100.0  # N, largest accepted force on a skin; a larger one would break it
# N/m, series stiffness of arm and mount where it was not measured: an assumption for a collaborative arm with a plastic
# mount. A rig sets its own in `limits.stiffness`, a simulation in `PressLimits.stiffness`.
ARM_STIFFNESS_N_PER_M = 10e3
CONTACT_TOLERANCE_M = 1.5e-3  # m, largest depth in a patch that counts as contact in a contact mask
MAX_POSE_M = 10.0  # m, largest accepted coordinate of a pose; no lab is larger
LAST_ROW_TOLERANCE = 1e-6  # largest error that counts as rounding in the last row of a pose matrix
# Largest accepted error in the products of a rotation's columns, which should be 1 or 0: 4 um at the rim of a patch.
ORTHOGONALITY_TOLERANCE = 1e-3
