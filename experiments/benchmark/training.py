"""Section `training` of the benchmark: the compiled epoch of i2t against eager PyTorch."""

from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.contests import Contest
from i2t import training as learning
from i2t.paper import loss, network
from i2t.paper.config import PaperConfig
from i2t.training import Batch, Learner, TrainConfig, TrainState


class Setup(NamedTuple):
    """Sizes of the timed training: the paper's network on as many touches as in the paper."""

    touches: int = 1630
    epochs: int = 10  # per turn
    model: PaperConfig = PaperConfig()
    train: TrainConfig = TrainConfig()


SMALL = Setup(20, 2, PaperConfig(pixels=6), TrainConfig(batch_size=8, learning_rate=1e-4))


def training(small: bool) -> Iterator[Contest]:
    """Compare the compiled epoch with eager PyTorch, with its fused and its foreach Adam."""
    setup = SMALL if small else Setup()
    batch, learner = random_touches(setup), Learner(setup.model, network.init, loss.losses)
    state = jax.jit(learning.init, static_argnums=(1, 2, 3))(jax.random.key(0), learner, setup.train, setup.touches)
    epoch = learning.compiled(learner, setup.train)

    def ours() -> list[float]:
        """Run the same epochs in each turn; return the mean loss of each."""
        now, totals = state, []
        for _ in range(setup.epochs):
            now, info = epoch(now, batch, None)
            totals.append(float(info.train.total[0]))
        return totals

    expected = ours()
    for adam in ("fused", "foreach"):
        peer = TorchTraining(setup, state, batch, adam)
        # The orders of float32 sums differ, and the differences grow over the epochs.
        np.testing.assert_allclose(peer.epochs(), expected, rtol=1e-3)
        yield Contest(
            f"epoch of {setup.touches} touches, minibatches of {setup.train.batch_size}", ours,
            f"eager PyTorch, {adam} Adam", peer.epochs, our_calls=1 / setup.epochs, peer_calls=1 / setup.epochs,
        )  # fmt: skip


class TorchTraining:
    """The same network, initial weights and minibatches in eager PyTorch."""

    def __init__(self, setup: Setup, state: TrainState, batch: Batch, adam: str) -> None:
        import torch

        self.torch, self.setup, self.epoch = torch, setup, 0
        self.key = state.key[0]
        on_gpu = jax.default_backend() == "gpu" and torch.cuda.is_available()
        self.device = "cuda" if on_gpu else "cpu"
        torch.set_float32_matmul_precision("high" if on_gpu else "highest")  # TF32 on a GPU, as in XLA
        self.images = torch.tensor(np.asarray(batch.inputs), device=self.device).flatten(1)
        self.targets = torch.tensor(np.asarray(batch.target), device=self.device)

        def linear(name: str) -> "torch.nn.Linear":
            kernel, bias = (torch.tensor(np.asarray(state.params[name][part][0])) for part in ("kernel", "bias"))
            layer = torch.nn.Linear(*kernel.shape)
            with torch.no_grad():
                layer.weight.copy_(kernel.T)
                layer.bias.copy_(bias)
            return layer

        def two_layers(first: str, second: str) -> "torch.nn.Sequential":
            return torch.nn.Sequential(linear(first), torch.nn.ReLU(), linear(second))

        self.encoder, self.decoder, self.head = (
            two_layers(*names) for names in (("encoder", "bottleneck"), ("decoder", "reading"), ("auxiliary", "image"))
        )
        parts = torch.nn.ModuleList([self.encoder, self.decoder, self.head]).to(self.device)
        self.adam = torch.optim.Adam(
            parts.parameters(), setup.train.learning_rate, fused=adam == "fused", foreach=adam == "foreach"
        )

    def epochs(self) -> list[float]:
        """Continue for one turn of epochs; return the mean loss of each."""
        return [self._epoch() for _ in range(self.setup.epochs)]

    def _epoch(self) -> float:
        size, touches = self.setup.train.batch_size, self.setup.touches
        rows, _ = learning.minibatches(self.key, jnp.int32(self.epoch), touches, size)
        order = self.torch.tensor(np.asarray(rows).ravel()[:touches], device=self.device)
        self.epoch += 1
        total = self.torch.zeros((), device=self.device)
        for index in order.split(size):
            image, target = self.images[index], self.targets[index]
            latent = self.encoder(image)
            loss = ((self.decoder(latent) - target) ** 2).mean() + ((self.head(latent) - image) ** 2).mean()
            self.adam.zero_grad(set_to_none=True)
            loss.backward()
            self.adam.step()
            total += loss.detach() * len(index)
        return float(total) / touches


def random_touches(setup: Setup) -> Batch:
    """Random data of the right shapes; the cost of training does not depend on the values."""
    rng = np.random.default_rng(0)
    image = rng.random((setup.touches, setup.model.pixels, setup.model.pixels), np.float32)
    target = rng.standard_normal((setup.touches, setup.model.readings), np.float32)
    return Batch(jnp.asarray(image), jnp.asarray(target))
