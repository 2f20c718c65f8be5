"""Members of the mixture that one skin's Gaussian process is: kernels of a population, each on a load and a board."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import logsumexp

from i2t.skin_models.tip_gp import kernel
from i2t.skin_models.tip_gp.kernel import UNIFORM_FAR_AMPLITUDE, SkinKernels
from i2t.types import in_one_line

NO_BOARD = -1
BOARD_SHARE = 0.5  # of the prior, of kernels that know where the chips are
PREVIOUS_SHARE = 0.5  # of the prior, of a previous session as the mean where there is one
PREVIOUS_NOISE_FACTORS = (1.0, 10.0, 100.0)  # on the noise of kernels that explain what a previous session leaves


@in_one_line
class Components(NamedTuple):
    """Members of the mixture."""

    kernels: SkinKernels
    load_column: Int[np.ndarray, " k"]
    uses_previous: Bool[np.ndarray, " k"]
    log_share: Float[np.ndarray, " k"]
    board: Int[np.ndarray, " k"]  # number of the board whose chips it knows, or NO_BOARD


def on_boards(kernels: SkinKernels, log_share: Float[np.ndarray, " s"], column: int, boards: int) -> Components:
    """Members of kernels: all of them without chips, and those that know chips once for each board.

    Args:
        kernels: s of them.
        log_share: Logarithms of their shares of the population.
        column: Of the loads, which the members take.
        boards: How many boards may be the skin's.

    Returns:
        The members.
    """

    def on(board: int, which: np.ndarray, share: float) -> Components:
        of, some = kernel.take(kernels, which), log_share[which]
        if board == NO_BOARD:
            of = of._replace(far_amplitude=np.full(len(some), UNIFORM_FAR_AMPLITUDE))
        every = np.ones(len(some), int)
        return Components(
            kernels=of,
            load_column=column * every,
            uses_previous=np.zeros(len(some), bool),
            log_share=some - logsumexp(some) + np.log(share),
            board=board * every,
        )

    falls = kernels.far_amplitude < UNIFORM_FAR_AMPLITUDE
    boards = boards if falls.any() else 0
    without = on(NO_BOARD, np.ones(len(falls), bool), 1 - BOARD_SHARE if boards else 1.0)
    return join_members(without, *(on(board, falls, BOARD_SHARE / boards) for board in range(boards)))


def with_previous(components: Components) -> Components:
    """Members joined by others, mostly noise, for what a previous session leaves of the readings.

    Args:
        components: For the readings.

    Returns:
        Both.
    """
    fresh = np.log(1 - PREVIOUS_SHARE)
    parts = [components._replace(log_share=components.log_share + fresh)]
    yes = np.ones(len(components.log_share), bool)
    for factor in PREVIOUS_NOISE_FACTORS:
        noisier = components.kernels._replace(noise_variance=factor * components.kernels.noise_variance)
        share = PREVIOUS_SHARE / len(PREVIOUS_NOISE_FACTORS)
        log_share = components.log_share + np.log(share)
        parts.append(components._replace(log_share=log_share, kernels=noisier, uses_previous=yes))
    return join_members(*parts)


def join_members(*parts: Components) -> Components:
    """Members one after the other.

    Args:
        parts: Of a mixture.

    Returns:
        All members.
    """
    names = Components._fields[1:]
    rest = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Components(kernels=kernel.join(*(part.kernels for part in parts)), **rest)


def take_members(components: Components, which: Int[np.ndarray, " j"]) -> Components:
    """Some of the members.

    Args:
        components: All of them.
        which: Their numbers.

    Returns:
        These members.
    """
    rest = {name: getattr(components, name)[which] for name in Components._fields[1:]}
    return Components(kernels=kernel.take(components.kernels, which), **rest)
