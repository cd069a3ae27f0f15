# SPDX-License-Identifier: Apache-2.0
"""The loop of the paper's Figure 4: build image sets, learn from them, until there are none."""

import time
from collections.abc import Generator, Mapping
from enum import StrEnum
from pathlib import Path

import numpy as np
import torch

from placerec.datasets import LabelledImages
from placerec.errors import RecognizerError
from placerec.files import Progress
from placerec.networks import PlaceNetwork
from placerec.training.checkpoint import Checkpoint, read_checkpoint, settings_of, write_checkpoint
from placerec.training.config import TrainingConfig
from placerec.training.image_sets import ImageSets, build_image_sets, one_of_each, sample_scenes
from placerec.training.learner import Learner
from placerec.training.log import StepRecord, TrainingLog
from placerec.training.workers import Workers

LOG_NAME = "log.csv"
CHECKPOINT_INTERVAL_S = 180.0
_EMPTY_ROUNDS = 5
"""So many rounds without a set in a row end a training: each draws other images and anchors."""
_NO_SETS = np.empty((2, 0, 0), np.int64)


class End(StrEnum):
    """Why a training is over."""

    LEARNED = "no image set can be formed: all places are told apart"
    STEPS = "max_steps is reached"
    SECONDS = "max_seconds have passed"


class Training:
    """Trains a network, one step per iteration; the network may be used between two steps.

    A folder that holds a checkpoint is gone on with, to the same result as without a stop. Leaving
    the loop early writes one. Under torchrun every process runs the same loop.

    Attributes:
        network: what is trained, in place.
        checkpoint_path: where the last good state is.
        end: why it is over, None while it is not.
    """

    end: End | None = None

    def __init__(
        self,
        network: PlaceNetwork,
        images: LabelledImages,
        config: TrainingConfig,
        folder: Path,
        *,
        workers: Workers | None = None,
        progress: Progress | None = None,
        origin: Mapping[str, str] | None = None,
    ) -> None:
        """Prepare a training, or go on with the one in the folder.

        Args:
            network: with the weights to start from.
            images: to learn from.
            config: how.
            folder: an existing one, for checkpoint.pt and log.csv.
            workers: default: those that torchrun started, on GPUs where there are any.
            progress: called while images are looked at to build sets, which may take long;
                KeyboardInterrupt raised in it stops the training with a checkpoint.
            origin: what else must be the same, by name, for the folder's training to go on.

        Raises:
            RecognizerError: the folder's checkpoint is damaged or of another training, a file
                cannot be written, or frozen_block does not fit.
        """
        self.network, self._images, self._places = network, images, images.places
        self._config, self.checkpoint_path = config, folder / "checkpoint.pt"
        self._workers = workers or Workers()
        self._progress = progress
        self._settings = settings_of(config, network, images) | dict(origin or {})
        self._learner = Learner(network, images, config, self._workers)
        self._sets, self._used, self._round, self._step = ImageSets(*_NO_SETS), 0, 0, 0
        self._started_s, self._elapsed_s, self._saved_s = 0.0, 0.0, -np.inf
        if self.checkpoint_path.exists():
            self._resume(read_checkpoint(self.checkpoint_path, self._settings))
        self._log = TrainingLog(folder / LOG_NAME, self._step) if self._workers.is_first else None

    def __iter__(self) -> Generator[StepRecord, None, None]:
        """Yield what each step did, until no set can be formed or the budget is spent.

        Raises:
            RecognizerError: the loss or a gradient is not finite (the last good checkpoint is
                kept), there are too few places for a set, or a file cannot be written.
        """
        self._started_s = time.monotonic() - self._elapsed_s
        self._learner.look_at_all(len(self._places), self._progress)
        try:
            while not self._is_over():
                yield self._learn()
        except GeneratorExit:
            self._save()
            raise
        self._save()

    def _is_over(self) -> bool:
        steps, minutes = self._config.steps, self._config.minutes
        self.end = None
        self._tick()
        if steps is not None and self._step >= steps:
            self.end = End.STEPS
        elif minutes is not None and self._workers.agree(self._elapsed_s >= 60.0 * minutes):
            self.end = End.SECONDS
        elif self._used == len(self._sets) and not self._find_sets():
            self.end = End.LEARNED
        return self.end is not None

    def _find_sets(self) -> bool:
        """Start rounds until one has sets, at most so many as could visit every scene so often."""
        scenes = len(np.unique(self._images.scenes))
        visits = -(-scenes // (self._config.scenes_per_round or scenes))
        for _ in range(_EMPTY_ROUNDS * visits):
            self._build_sets()
            if len(self._sets):
                return True
        return False

    def _build_sets(self) -> None:
        """Start a round: one anchor of each place, among the images looked at this time."""
        config, scenes = self._config, self._images.scenes
        rng = np.random.default_rng([config.seed, self._round])
        visited = sample_scenes(
            scenes,
            self._places,
            self._images.collections,
            config.scenes_per_round or len(scenes),
            config.places_per_scene or len(scenes),
            rng,
        )
        anchors = visited[one_of_each(self._places[visited], rng)]
        self._refuse_too_few(len(anchors))
        neighbours = config.rules.neighbours
        seen = self._images.around(anchors, config.images_per_place, neighbours, rng)
        try:
            features = self._learner.embed(seen, self._progress)
        except KeyboardInterrupt:  # may come from progress; all is still as after the last step
            self._save()
            raise
        truth, rows = self._images.pairs(seen), np.searchsorted(seen, rng.permutation(anchors))
        sets = build_image_sets(features, truth, rng, config.rules, rows)
        self._sets = ImageSets(seen[sets.positives], seen[sets.negatives])
        self._used, self._round = 0, self._round + 1

    def _refuse_too_few(self, places: int) -> None:
        others = self._config.rules.negatives
        if places <= others:
            raise RecognizerError(
                f"the images show {places} places, and {others + 1} are needed: a set is one place "
                f"and {others} others; give more places or ask for fewer negatives"
            )

    def _learn(self) -> StepRecord:
        before_s = self._elapsed_s
        chosen = slice(self._used, self._used + self._config.batch_sets)
        batch = ImageSets(self._sets.positives[chosen], self._sets.negatives[chosen])
        loss, active_share, is_finite = self._learner.work_out_gradients(batch, self._step)
        if not is_finite:
            raise self._breakdown(f"the loss is {loss:g} or a gradient is not finite")
        self._tick()
        # Only now are the weights known to be good: what they led to is finite.
        if self._elapsed_s - self._saved_s >= CHECKPOINT_INTERVAL_S:
            self._save()
        learning_rate = self._learner.update(self._step)
        if not self._learner.is_sound():
            raise self._breakdown("weights have grown beyond what a file holds")
        self._step, self._used = self._step + 1, self._used + len(batch)
        self._tick()
        images = batch.positives.size + batch.negatives.size
        sets_left = len(self._sets) - self._used
        record = StepRecord(
            step=self._step,
            round=self._round,
            loss=loss,
            active_share=active_share,
            sets_left=sets_left,
            learning_rate=learning_rate,
            images_per_s=images / max(self._elapsed_s - before_s, 1e-9),
            elapsed_s=self._elapsed_s,
            time_to_go_s=self._time_to_go_s(sets_left),
        )
        if self._log:
            self._log.add(record)
        return record

    def _breakdown(self, what: str) -> RecognizerError:
        return RecognizerError(
            f"the training broke down at step {self._step + 1}: {what}; go on with a lower "
            f"learning_rate from the last good checkpoint: {self.checkpoint_path}"
        )

    def _time_to_go_s(self, sets_left: int) -> float:
        config, per_step_s = self._config, self._elapsed_s / self._step
        limits_s = []
        if config.steps is not None:
            limits_s.append((config.steps - self._step) * per_step_s)
        if config.minutes is not None:
            limits_s.append(60.0 * config.minutes - self._elapsed_s)
        return max(0.0, min(limits_s, default=sets_left / config.batch_sets * per_step_s))

    def _tick(self) -> None:
        self._elapsed_s = time.monotonic() - self._started_s

    def _save(self) -> None:
        self._saved_s = self._elapsed_s
        if not self._workers.is_first:
            return
        checkpoint = Checkpoint(
            settings=self._settings,
            network=self.network.state_dict(),
            optimizer=self._learner.optimizer.state_dict(),
            positives=torch.from_numpy(self._sets.positives),
            negatives=torch.from_numpy(self._sets.negatives),
            used=self._used,
            round=self._round,
            step=self._step,
            elapsed_s=self._elapsed_s,
        )
        write_checkpoint(checkpoint, self.checkpoint_path)

    def _resume(self, checkpoint: Checkpoint) -> None:
        try:
            self.network.load_state_dict(checkpoint.network)
            self._learner.optimizer.load_state_dict(checkpoint.optimizer)
        except Exception as error:  # torch raises many kinds for what does not fit
            raise RecognizerError(
                "the checkpoint does not fit its network; remove it to start anew:"
                f" {self.checkpoint_path}"
            ) from error
        self._sets = ImageSets(checkpoint.positives.numpy(), checkpoint.negatives.numpy())
        self._used, self._round, self._step = checkpoint.used, checkpoint.round, checkpoint.step
        self._elapsed_s = checkpoint.elapsed_s
