"""Members of the mixture that models one skin: kernels of a population, each for one load and one board."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import logsumexp

from i2t.skin_models.tip_gp import kernel
from i2t.skin_models.tip_gp.kernel import UNIFORM_FAR_AMPLITUDE, SkinKernels
from i2t.types import in_one_line

NO_CHIP_POSITIONS = -1  # board number of a member of the mixture whose kernel does not use chip positions


@in_one_line
class Components(NamedTuple):
    """k members of a mixture of Gaussian processes: kernels with their load, board, log prior share and kind of mean.

    The mean is zero or the prediction of a previous session.
    """

    kernels: SkinKernels
    load_column: Int[np.ndarray, " k"]
    uses_previous: Bool[np.ndarray, " k"]
    log_share: Float[np.ndarray, " k"]
    board: Int[np.ndarray, " k"]  # number of the board whose chips the member uses, or NO_CHIP_POSITIONS


def kernels_on_boards(
    kernels: SkinKernels,
    log_share: Float[np.ndarray, " s"],
    column: int,
    boards: int,
    *,
    board_weight: float = 0.5,
) -> Components:
    """Make mixture members of kernels: each once without chip positions, and those that use chips once for each board.

    Args:
        kernels: A stack of s kernels.
        log_share: `(s,)` logarithms of the kernels' shares of the population.
        column: Column of the loads that the members use.
        boards: Number of boards that the skin may have.
        board_weight: Prior weight of the members that use chip positions.

    Returns:
        The members, without chips first and then board by board.
    """

    def on(board: int, which: np.ndarray, share: float) -> Components:
        some_kernels, some = kernel.take(kernels, which), log_share[which]
        if board == NO_CHIP_POSITIONS:
            some_kernels = some_kernels._replace(far_amplitude=np.full(len(some), UNIFORM_FAR_AMPLITUDE))
        ones = np.ones(len(some), int)
        return Components(
            kernels=some_kernels,
            load_column=column * ones,
            uses_previous=np.zeros(len(some), bool),
            log_share=some - logsumexp(some) + np.log(share),
            board=board * ones,
        )

    falls = kernels.far_amplitude < UNIFORM_FAR_AMPLITUDE
    boards = boards if falls.any() else 0
    without = on(NO_CHIP_POSITIONS, np.ones(len(falls), bool), 1 - board_weight if boards else 1.0)
    return join_members(without, *(on(board, falls, board_weight / boards) for board in range(boards)))


def add_previous_session(
    components: Components, *, previous_weight: float = 0.5, noise_factors: tuple[float, ...] = (1.0, 10.0, 100.0)
) -> Components:
    """Add mixture members that model the difference of the readings from a previous session's prediction.

    Args:
        components: Members that model the readings.
        previous_weight: Prior weight of the added members.
        noise_factors: Factors on the noise of the added members, since the difference is mostly noise.

    Returns:
        The given members, followed by the added ones for each factor.
    """
    fresh = np.log(1 - previous_weight)
    parts = [components._replace(log_share=components.log_share + fresh)]
    yes = np.ones(len(components.log_share), bool)
    for factor in noise_factors:
        noisier = components.kernels._replace(noise_variance=factor * components.kernels.noise_variance)
        share = previous_weight / len(noise_factors)
        log_share = components.log_share + np.log(share)
        parts.append(components._replace(log_share=log_share, kernels=noisier, uses_previous=yes))
    return join_members(*parts)


def join_members(*parts: Components) -> Components:
    """Concatenate the members of mixtures.

    Args:
        parts: Members of a mixture.

    Returns:
        All members in the given order.
    """
    names = Components._fields[1:]
    rest = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Components(kernels=kernel.join(*(part.kernels for part in parts)), **rest)


def take_members(components: Components, which: Int[np.ndarray, " j"]) -> Components:
    """Select some members of a mixture.

    Args:
        components: All members.
        which: `(j,)` numbers of the selected members.

    Returns:
        The j selected members.
    """
    rest = {name: getattr(components, name)[which] for name in Components._fields[1:]}
    return Components(kernels=kernel.take(components.kernels, which), **rest)
