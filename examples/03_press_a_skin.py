"""Press a skin onto a surface, and compute pressure, force and reading.

python examples/03_press_a_skin.py
"""

import numpy as np

import i2t
from i2t.skin.elasticity import GRID, interior, load


def main(out: str = "runs/press.png") -> np.ndarray:
    """Press a ball of 8 mm radius 0.4 mm deep into a nominal skin off centre, draw it, and return the reading."""
    pad = i2t.nominal_pad()  # a ReSkin of medium thickness and stiffness; nominal_pad(board=...) for other boards
    x, y = GRID.centres[None, :] - 3e-3, GRID.centres[:, None]  # m from the ball's lowest point, row along tool y
    pressed = i2t.press(pad, (x**2 + y**2) / (2 * 8e-3), 0.4e-3)

    print(f"{float(pressed.force):.2f} N, {1e-3 * float(pressed.pressure.max()):.0f} kPa maximum pressure (simulated)")
    for chip, (bx, by, bz) in enumerate(np.asarray(pressed.reading).reshape(-1, 3)):
        print(f"chip {chip}: {bx:7.1f} {by:7.1f} {bz:7.1f} uT")
    moved, _ = interior(
        pad, load(pad, pressed.pressure), 0.0
    )  # (3, n, n) m, displacement of the surface along tool x, y, z
    board = i2t.Board(*map(np.asarray, pad.board))
    figure = i2t.viz.plot_press(
        np.asarray(pressed.pressure),
        -np.asarray(moved[2]),
        board,
        np.asarray(pressed.reading),
        "A ball, 0.4 mm deep",
        simulated=True,
    )
    print(f"figure: {i2t.viz.save_figure(figure, out)}")
    return np.asarray(pressed.reading)


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
