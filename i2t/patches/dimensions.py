"""Lengths of patches and skins, and the stiffness behind them, for users without arrays: this imports nothing."""

PATCH_PIXELS = 48
PATCH_WINDOW = 17e-3  # m, edge of the square that the paper crops around the tool axis
WIDE_PIXELS = 72
WIDE_WINDOW = PATCH_WINDOW * WIDE_PIXELS / PATCH_PIXELS  # 25.5 mm: same pixels, and the patch is its central 48 x 48
TWIST_LEVER_M = PATCH_WINDOW / 2  # m, at which a rotation is measured in a twist
REACH = 4e-3  # m, depth of a patch behind the nearest surface point
STANDOFF = 40e-3  # m, rays start this far behind the tool origin
PAD_WINDOW = 20e-3  # m, edge of the skin
MAX_SKIN_FORCE_N = 100.0  # more breaks a skin
# N/m, of arm and mount in series, where nobody measured them: an assumption for a collaborative arm with a plastic
# mount. A rig's own is `limits.stiffness`, a simulated one's `PressLimits.stiffness`.
ARM_STIFFNESS_N_PER_M = 10e3
CONTACT_TOLERANCE_M = 1.5e-3  # behind the nearest point, that counts as contact in a mask
MAX_POSE_M = 10.0  # m, of a pose along each axis: the largest sensible lab
LAST_ROW_TOLERANCE = 1e-6  # of a pose, by rounding
ORTHOGONALITY_TOLERANCE = 1e-3  # by which products of a rotation's columns may miss 1 and 0: 4 um at the rim of a patch
