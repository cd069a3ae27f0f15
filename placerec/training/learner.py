# SPDX-License-Identifier: Apache-2.0
"""One step of learning from image sets, shared among all processes."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from placerec.datasets import LabelledImages
from placerec.errors import RecognizerError
from placerec.files import Progress
from placerec.networks import PlaceNetwork
from placerec.training.config import Loss, TrainingConfig
from placerec.training.image_sets import ImageSets
from placerec.training.images import Augmentation
from placerec.training.losses import (
    draw_partners,
    multi_constraint_loss,
    simplified_multi_constraint_loss,
    triplet_loss,
)
from placerec.training.workers import Workers

IMAGES_PER_PASS = 32
_WARM_UP_STEPS = 50
"""Steps over which the learning rates rise: Adam knows the gradients' sizes only after some."""
_LARGEST_GRADIENT = 2.0
"""Norm to which longer gradients are cut: one odd batch must not undo many good ones."""
_PARTNERS, _VIEWS, _LAYERS = 1, 2, 3
"""What random numbers are drawn for: each has its own, by the seed and the step."""


class Learner:
    """Embeds images and learns from sets of them, with the same result for any number of processes.

    The layers up to frozen_block stay as they are: what they make of an image is looked up.

    Attributes:
        network: what learns.
        optimizer: Adam, with one learning rate for the trunk and one for the last layer.
    """

    def __init__(
        self,
        network: PlaceNetwork,
        images: LabelledImages,
        config: TrainingConfig,
        workers: Workers,
    ) -> None:
        """Move the network to the workers' device and freeze its early layers.

        Raises:
            RecognizerError: frozen_block does not fit the network.
        """
        self.network = network.to(workers.device)
        self._images, self._config, self._workers = images, config, workers
        network.requires_grad_(True)  # what an earlier training froze may be trained now
        self._frozen, self._trained = _split(network, config.frozen_block)
        self._frozen.requires_grad_(False)
        self._maps: Tensor | None = None
        self._rates = (config.learning_rate, config.trunk_learning_rate)
        last = [*network.pool.parameters(), *network.fully_connected.parameters()]
        groups = [{"params": each} for each in (last, list(self._trained.parameters()))]
        self.optimizer = torch.optim.Adam([group for group in groups if group["params"]])

    def look_at_all(self, count: int, progress: Progress | None = None) -> None:
        """Work out once what the frozen layers make of all n images."""
        if self._config.frozen_block is None:
            return
        maps: list[Tensor] = []
        # Always in the same portions: the last bits of a map depend on what it is computed with.
        for start in range(0, count, IMAGES_PER_PASS):
            indices = range(start, min(start + IMAGES_PER_PASS, count))
            maps.append(self._through([self._images[i] for i in indices]).cpu())
            if progress:
                progress(indices.stop, count)
        self._maps = torch.cat(maps)

    @torch.no_grad()
    def embed(
        self, images: NDArray[np.int64], progress: Progress | None = None
    ) -> NDArray[np.float32]:
        """Return the (N, D) embeddings of N training images as they are, known to all processes."""
        device = self._workers.device
        features = torch.zeros(len(images), self.network.dimension, device=device)
        passes = -(-len(images) // IMAGES_PER_PASS)
        self.network.eval()
        for k in self._workers.share(passes):
            rows = slice(k * IMAGES_PER_PASS, (k + 1) * IMAGES_PER_PASS)
            features[rows] = self._forward(self._plain(images[rows]))
            if progress:
                progress(min((k + 1) * IMAGES_PER_PASS, len(images)), len(images))
        self._workers.add_up([features])
        return np.asarray(features.cpu(), np.float32)

    def work_out_gradients(self, sets: ImageSets, step: int) -> tuple[float, float, bool]:
        """Leave the gradients of the sets' mean loss with the parameters.

        Returns:
            The mean loss, the share of the sets that have any, and whether all is finite.
        """
        for parameter in self._parameters():
            parameter.grad = torch.zeros_like(parameter)  # also where this process has no share
        own = np.array(self._workers.share(len(sets)), np.int64)
        found = torch.zeros(2, device=self._workers.device)
        if len(own):
            with self._random_numbers(step):
                self.network.train()
                losses = self._losses(sets, own, step)
                torch.autograd.backward(losses.sum() / len(sets))
                self.network.eval()
            found = torch.stack([losses.detach().sum(), (losses > 0).float().sum()]) / len(sets)
        gradients = [p.grad for p in self._parameters() if p.grad is not None]
        self._workers.add_up([found, *gradients])
        is_finite = all(bool(value.isfinite().all()) for value in (found, *gradients))
        return float(found[0]), float(found[1]), is_finite

    def update(self, step: int) -> float:
        """Change the parameters by their gradients and return the last layer's learning rate."""
        limit = self._config.steps
        share = 0.5 * (1.0 + math.cos(math.pi * step / limit)) if limit else 1.0
        share *= min(1.0, (step + 1) / _WARM_UP_STEPS)
        torch.nn.utils.clip_grad_norm_(list(self._parameters()), _LARGEST_GRADIENT)
        for group, rate in zip(self.optimizer.param_groups, self._rates, strict=False):
            group["lr"] = rate * share
        self.optimizer.step()
        return self._rates[0] * share

    def is_sound(self) -> bool:
        """Return whether all weights are numbers that a file of weights can hold."""
        most = torch.finfo(torch.float16).max
        return all(bool((p.detach().abs() <= most).all()) for p in self._parameters())

    def _losses(self, sets: ImageSets, own: NDArray[np.int64], step: int) -> Tensor:
        """Return the losses of some of a step's sets."""
        config = self._config
        rng = np.random.default_rng([config.seed, _PARTNERS, step])
        partners = torch.from_numpy(draw_partners(len(sets), sets.negatives.shape[1], rng)[own])
        images = np.concatenate([sets.positives[own], sets.negatives[own]], axis=1)
        different, which = np.unique(images, return_inverse=True)  # sets share images
        embeddings = self._forward(self._views(different, step))[which.reshape(images.shape)]
        count = sets.positives.shape[1]
        positives, negatives = embeddings[:, :count], embeddings[:, count:]
        if config.loss == Loss.TRIPLET:
            shown = torch.from_numpy(sets.positives[own]).to(self._workers.device)
            is_pair = shown[:, :, None] != shown[:, None, :]
            return triplet_loss(positives, negatives, is_pair, config.alpha)
        loss = (
            multi_constraint_loss if config.loss == Loss.FULL else simplified_multi_constraint_loss
        )
        partners = partners.to(self._workers.device)
        return loss(positives, negatives, partners, config.alpha, config.beta)

    def _views(self, images: NDArray[np.int64], step: int) -> Tensor:
        """Return the trained layers' input of N images, each changed by its own random numbers."""
        if not self._config.augment:
            return self._plain(images)
        change = Augmentation()
        draws = [np.random.default_rng([self._config.seed, _VIEWS, step, i]) for i in images]
        views = [change(self._images[int(i)], rng) for i, rng in zip(images, draws, strict=True)]
        return self._through(views)

    def _plain(self, images: NDArray[np.int64]) -> Tensor:
        """Return the trained layers' input of N images as they are."""
        if self._maps is not None:
            return self._maps[torch.from_numpy(images)].to(self._workers.device)
        return self._through([self._images[int(i)] for i in images])

    @torch.no_grad()
    def _through(self, images: list[NDArray[np.uint8]]) -> Tensor:
        """Return what the frozen layers make of images."""
        maps: Tensor = self._frozen.eval()(self.network.prepare(images).to(self._workers.device))
        return maps

    def _forward(self, inputs: Tensor) -> Tensor:
        """Return (N, D) float32 embeddings; in mixed precision on a GPU, or if asked for."""
        device = self._workers.device.type
        is_mixed = device == "cuda" or self._config.mixed_precision
        with torch.autocast(device, torch.bfloat16, enabled=is_mixed):
            embeddings = self.network.project(self._trained(inputs))
        return embeddings.float()

    def _parameters(self) -> Iterator[Tensor]:
        return (p for group in self.optimizer.param_groups for p in group["params"])

    @contextmanager
    def _random_numbers(self, step: int) -> Iterator[None]:
        """Let layers that draw, such as dropout, draw by the seed and the step."""
        device, rank = self._workers.device, self._workers.rank
        seed = np.random.default_rng([self._config.seed, _LAYERS, step, rank]).integers(1 << 62)
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(int(seed))
            yield


def _split(network: PlaceNetwork, frozen_block: str | None) -> tuple[nn.Module, nn.Module]:
    """Return a trunk's layers up to the end of a block, and those behind it."""
    layers = network.features
    if frozen_block is None:
        return nn.Identity(), layers
    count = network.trunk.layer_count(frozen_block)
    if not isinstance(layers, nn.Sequential) or count > len(layers):
        raise RecognizerError(
            f"frozen_block = {frozen_block!r}: the network is cut before it, "
            f"after {network.block!r}"
        )
    return layers[:count], layers[count:]
