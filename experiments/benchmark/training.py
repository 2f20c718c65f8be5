"""Section `training` of the benchmark: our compiled epoch against eager PyTorch."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.timing import BenchmarkRow, MissingPeerError, compare, interleave
from i2t import training
from i2t.paper import loss, network
from i2t.paper.config import PaperConfig
from i2t.training import Batch, Learner, TrainConfig, TrainState


@dataclass(frozen=True)
class Training:
    """An epoch of the paper's network on a set of the paper's size."""

    touches: int = 1630
    epochs: int = 10  # timed together, in one turn
    model: PaperConfig = field(default_factory=PaperConfig)
    train: TrainConfig = field(default_factory=lambda: TrainConfig())


def section(setup: Training, turns: int) -> list[BenchmarkRow]:
    """Our compiled epoch against eager PyTorch."""
    batch = _random_touches(setup)
    learner = Learner(setup.model, network.init, loss.losses)
    key = jax.random.key(0)
    state = jax.jit(training.init, static_argnums=(1, 2, 3))(key, learner, setup.train, setup.touches)
    epoch = training.compiled(learner, setup.train)

    def ours() -> list[float]:
        """The same epochs each turn, the mean loss of each."""
        now, totals = state, []
        for _ in range(setup.epochs):
            now, info = epoch(now, batch, None)
            totals.append(float(info.train.total[0]))
        return totals

    peers = {name: TorchTraining(setup, state, batch, name) for name in ("fused", "foreach")}
    expected = ours()
    for peer in peers.values():
        # Float32 sums of some thousand terms in another order, carried through some epochs of Adam.
        np.testing.assert_allclose(peer.epochs(), expected, rtol=1e-3)

    contenders: dict[str, Callable[[], object]] = {"ours": ours}
    contenders |= {name: peer.epochs for name, peer in peers.items()}
    seconds = {name: [s / setup.epochs for s in each] for name, each in interleave(contenders, turns).items()}
    best = min(peers, key=lambda name: statistics.median(seconds[name]))
    what = f"epoch of {setup.touches} touches, minibatches of {setup.train.batch_size}"
    return [compare("training", what, seconds["ours"], f"eager PyTorch, {best} Adam", seconds[best])]


class TorchTraining:
    """The same network, initial weights and minibatches in eager PyTorch, on tensors that are indexed for each
    minibatch.
    """

    def __init__(self, setup: Training, state: TrainState, batch: Batch, adam: str) -> None:
        try:
            import torch
        except ImportError as error:
            raise MissingPeerError(
                "Section training compares with PyTorch, which is not installed; "
                "run pip install 'imagine2touch[bench]'."
            ) from error
        if setup.model != PaperConfig(pixels=setup.model.pixels):
            raise ValueError("Section training compares the paper's network only; leave --training.model as it is.")
        self.torch, self.setup, self.epoch = torch, setup, 0
        self.key = jax.random.wrap_key_data(state.key[0])
        self.images = torch.tensor(np.asarray(batch.inputs)).flatten(1)
        self.targets = torch.tensor(np.asarray(batch.target))

        def linear(name: str) -> "torch.nn.Linear":
            kernel, bias = (torch.tensor(np.asarray(state.params[name][part][0])) for part in ("kernel", "bias"))
            layer = torch.nn.Linear(*kernel.shape)
            with torch.no_grad():
                layer.weight.copy_(kernel.T)
                layer.bias.copy_(bias)
            return layer

        def two(first: str, second: str) -> "torch.nn.Sequential":
            return torch.nn.Sequential(linear(first), torch.nn.ReLU(), linear(second))

        self.encoder, self.decoder, self.head = (
            two(*names) for names in (("encoder", "bottleneck"), ("decoder", "reading"), ("auxiliary", "image"))
        )
        parts = torch.nn.ModuleList([self.encoder, self.decoder, self.head])
        self.adam = torch.optim.Adam(
            parts.parameters(), setup.train.learning_rate, fused=adam == "fused", foreach=adam == "foreach"
        )

    def epochs(self) -> list[float]:
        """Go on for the turn's epochs; the mean loss of each."""
        return [self._epoch() for _ in range(self.setup.epochs)]

    def _epoch(self) -> float:
        size, touches = self.setup.train.batch_size, self.setup.touches
        rows, _ = training.minibatches(self.key, jnp.int32(self.epoch), touches, size)
        order = self.torch.tensor(np.asarray(rows).ravel()[:touches])
        self.epoch += 1
        total = self.torch.zeros(())
        for index in order.split(size):
            image, target = self.images[index], self.targets[index]
            latent = self.encoder(image)
            loss = ((self.decoder(latent) - target) ** 2).mean() + ((self.head(latent) - image) ** 2).mean()
            self.adam.zero_grad(set_to_none=True)
            loss.backward()
            self.adam.step()
            total += loss.detach() * len(index)
        return float(total) / touches


def _random_touches(setup: Training) -> Batch:
    """Numbers of the right shapes: what a training costs does not depend on what it learns."""
    rng = np.random.default_rng(0)
    image = rng.random((setup.touches, setup.model.pixels, setup.model.pixels), np.float32)
    target = rng.standard_normal((setup.touches, setup.model.readings), np.float32)
    return Batch(jnp.asarray(image), jnp.asarray(target))
