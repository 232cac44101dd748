# SPDX-License-Identifier: MIT
"""The LightningModule: field, renderer, loss and metrics. It writes no file.

In: batches of range slices. Out: predicted magnitudes (B, E, R, F), the loss, and errors in
decibels on validation and test poses. Fields and renderers are plugins, made by name. Section 3 of
``docs/method.md``; the paper's loss and schedule: ``docs/paper.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import lightning
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn.utils import clip_grads_with_norm_, get_total_norm
from torchmetrics import MeanMetric

from sononerf.echoes.echoes import Echoes
from sononerf.echoes.region import EchoRegion
from sononerf.errors import IncompatibleError, InputError, NumericalError, SettingsError, expect
from sononerf.field.checkpoint_io import DurableCheckpointIO
from sononerf.field.datamodule import RangeSlices, seed_of
from sononerf.field.field import Field
from sononerf.field.renderer import Possible, Renderer, tensor
from sononerf.head.front_end import ACTIVE_DB, RANGE_DB
from sononerf.head.head import Head
from sononerf.numerics import Floats
from sononerf.settings.loading import FIELDS, RENDERERS, call, check_options, checked_section, load
from sononerf.settings.schema import (
    FieldSettings,
    FitSettings,
    RendererSettings,
    SpectrogramSettings,
)

Made = TypeVar("Made")
FieldFactory = Callable[..., Field]
"""Called with the region (2, 3), m, the frequencies (F,), Hz, and keyword options."""
RendererFactory = Callable[..., Renderer]
"""Called with the region (2, 3), m, the head, and keyword options."""


def box_of(region: ArrayLike | Tensor) -> Tensor:
    """Return a region (2, 3), m, in single precision."""
    given = region if isinstance(region, Tensor) else torch.as_tensor(np.array(region, np.float64))
    box = given.detach().to(torch.float32)
    if box.shape != (2, 3) or not bool((box[0] < box[1]).all()):
        raise SettingsError(
            f"region: found {box.tolist()}; give lower and upper corner, (2, 3) in metres, the "
            "lower below the upper on every axis"
        )
    return box


def make(
    given: Made | Callable[..., Made] | str,
    kind: type[Made],
    region: Tensor,
    head: Head | None,
    options: Mapping[str, Any],
) -> Made:
    """Return the object itself, or the one that a plugin's factory, or a factory, makes.

    In: region ((2, 3), m).
    """
    if isinstance(given, kind):
        return given
    what = kind.__name__.lower()
    group = FIELDS if issubclass(kind, Field) else RENDERERS
    factory = load(group, given) if isinstance(given, str) else given
    if not callable(factory):
        raise InputError(
            f"{what} is a {type(factory).__name__}, expected the name of a plugin, a factory or a "
            f"sononerf {kind.__name__}"
        )
    if head is None:
        raise SettingsError("head: missing; give the head that heard the echoes")
    chosen = check_options(factory, options, where=f"{what}.options", given=2)
    heard = tensor(head.frequency) if group == FIELDS else head
    if isinstance(given, str):
        result = call(f"{what} {given!r}", factory, region, heard, **chosen)
    else:
        result = factory(region, heard, **chosen)
    if not isinstance(result, kind):
        raise InputError(
            f"{given!r} makes a {type(result).__name__}, expected a sononerf {kind.__name__}"
        )
    return result


ASSUMED_STEPS = 10**9
"""Number of steps that is assumed if a Trainer sets no end: the learning rate then stays the
same."""

WORTH_THREADS = 40_000
"""Number of places per step below which several threads cost more than they save. On two cores and
12,000 places, two threads take 0.75 of the time of one on an idle machine, and 2.5 times as long
beside other work. The figure is for lobes; for a network several threads always save time."""


def decibels(magnitude: Tensor, reference: float | Tensor) -> Tensor:
    """Compress: 20 log10(1 + m / m0), in dB; zero for silence."""
    return 20.0 * torch.log10(1.0 + magnitude / reference)


def _possible(region: EchoRegion, places: Tensor, tolerance: float) -> Tensor:
    left = region.possible(places.cpu().double().numpy(), tolerance)
    if not left.any():
        left[:] = True  # the user's own box is kept whole
    return torch.as_tensor(left, device=places.device)


class EchoModule(lightning.LightningModule):
    """A reflectivity field and its renderer, fitted to echoes by any Lightning Trainer.

    :meth:`for_echoes` makes one whose region and loudness follow from echoes. Hyperparameters are
    plain data, so that ``load_from_checkpoint`` makes the module again; a field or a renderer that
    was given as an object has to be given again.

    Args:
        field: The learned field: the name of a plugin, ``"grid"`` or ``"fourier"``; a factory;
            or a field.
        renderer: Its renderer: the name of a plugin, ``"profile"`` or ``"shell"``; a factory; or
            a renderer.
        reference: Magnitude m0 of the reported decibels.
        region ((2, 3), m): Lower and upper corner of the box that holds the field; that of a field
            object by default.
        head: The head that heard the echoes, or what ``Head.plain`` says of it; needed unless
            field and renderer are objects.
        field_options, renderer_options: Keyword arguments of the factories.
        options: Options of the fit: keys of the section ``fit`` of the settings, such as
            ``{"learning_rate": 0.05, "loss": "l2", "schedule": "staircase", "seed": 1}``.
        dynamic_range_db: Level below the loudest cell at which the fit's own compression starts;
            the head's (``spectrogram``) by default.
        possible: Test of places against the echoes.

    Attributes:
        head: As given; None where field and renderer are objects and it was not.
        options: As given, with defaults.
        total_steps, steps_per_epoch: Length of the fit; the Trainer's, once it fits.

    Raises:
        SettingsError: If a name or an option is not allowed, or options do not go together.
        InputError: If a plugin cannot be loaded, or makes something else.
    """

    def __init__(
        self,
        field: Field | FieldFactory | str,
        renderer: Renderer | RendererFactory | str,
        *,
        reference: float,
        region: ArrayLike | None = None,
        head: Head | Mapping[str, Any] | None = None,
        field_options: Mapping[str, Any] | None = None,
        renderer_options: Mapping[str, Any] | None = None,
        options: FitSettings | Mapping[str, Any] | None = None,
        dynamic_range_db: float | None = None,
        possible: Possible | None = None,
    ) -> None:
        super().__init__()
        options = checked_section(FitSettings, options or {}, "fit")
        self.head = Head.from_plain(head) if isinstance(head, Mapping) else head
        if region is None:
            if not isinstance(field, Field):
                raise SettingsError("region: missing; give lower and upper corner in metres")
            region = field.region
        box = box_of(region)
        region = box.tolist()  # plain: Lightning compares the arguments with a dictionary
        self.save_hyperparameters(
            {
                **({"field": field} if isinstance(field, str) else {}),
                **({"renderer": renderer} if isinstance(renderer, str) else {}),
                "reference": float(reference),
                "region": region,
                "head": None if self.head is None else self.head.plain(),
                "field_options": dict(field_options or {}),
                "renderer_options": dict(renderer_options or {}),
                "options": options.model_dump(mode="json"),
                "dynamic_range_db": dynamic_range_db,
            }
        )
        # A generator of its own leaves the caller's random numbers alone.
        with torch.random.fork_rng(devices=[]):
            torch.default_generator.manual_seed(options.seed)
            self.field = make(field, Field, box, self.head, field_options or {})
            self.renderer = make(renderer, Renderer, box, self.head, renderer_options or {})
        if options.silent_share < 1.0 and self.renderer.whole_poses:
            raise SettingsError(
                f"fit.silent_share: found {options.silent_share:g}, but renderer {renderer!r} "
                "takes whole poses; lower fit.silent_weight instead, or take a renderer of single "
                "slices, such as shell"
            )
        if dynamic_range_db is None:
            spectrogram = SpectrogramSettings() if self.head is None else self.head.spectrogram
            dynamic_range_db = spectrogram.dynamic_range_db
        self.reference = reference
        self.dynamic_range_db = dynamic_range_db
        self.options = options
        self.possible = possible
        self.learning_rate = options.learning_rate or self.field.learning_rate
        self.total_steps = self.steps_per_epoch = 1
        self.active_db: float | Floats = ACTIVE_DB
        self.mae = MeanMetric()
        self.mae_active = MeanMetric()

    @classmethod
    def for_echoes(
        cls,
        echoes: Echoes,
        field: Field | FieldFactory | str = FieldSettings.model_fields["kind"].default,
        renderer: Renderer | RendererFactory | str = RendererSettings.model_fields["kind"].default,
        *,
        region: ArrayLike | None = None,
        field_options: Mapping[str, Any] | None = None,
        renderer_options: Mapping[str, Any] | None = None,
        options: FitSettings | Mapping[str, Any] | None = None,
    ) -> EchoModule:
        """Return an unfitted module whose region and loudness are those of echoes.

        Args:
            echoes: The echoes to fit.
            field, renderer, field_options, renderer_options, options: As of the class.
            region ((2, 3), m): Lower and upper corner; by default the box of the echoes
                (:meth:`sononerf.Echoes.within`), or found from the echoes.

        Raises:
            NumericalError: If no pose heard anything, or no more than noise gives.
            SettingsError, InputError: As the class.
        """
        expect(echoes, Echoes, "echoes")
        if region is None:
            own = field.region if isinstance(field, Field) else echoes.box
            region = echoes.region.box() if own is None else own
        made = cls(
            field,
            renderer,
            reference=echoes.reference,
            region=region,
            head=echoes.head,
            field_options=field_options,
            renderer_options=renderer_options,
            options=options,
            possible=partial(_possible, echoes.region),  # no closure: strategies pickle it
        )
        made.active_db = echoes.active_db
        return made

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]  # no option of Lightning's runs code here
        cls, checkpoint_path: Path | str, **arguments: Any
    ) -> EchoModule:
        """Return the module of a checkpoint, on the CPU; no code of the file is run.

        Args:
            checkpoint_path: A checkpoint that a Trainer wrote.
            arguments: Arguments of the class, in place of those that were saved: ``field`` or
                ``renderer`` where these were no names. Lightning's ``map_location`` and
                ``weights_only`` change nothing.

        Raises:
            InputError: If the file is missing, damaged, or holds more than plain data.
            IncompatibleError: If it is the checkpoint of another class.
        """
        content = DurableCheckpointIO().load_checkpoint(checkpoint_path)
        for ignored in ("map_location", "weights_only"):
            arguments.pop(ignored, None)
        try:
            module = cls(**{**content.get("hyper_parameters", {}), **arguments})
            module.load_state_dict(content["state_dict"])
        except (TypeError, KeyError, RuntimeError) as error:
            raise IncompatibleError(
                f"{checkpoint_path}: is no checkpoint of this EchoModule "
                f"({str(error).splitlines()[0]}); a field or a renderer that was no name has to be "
                "given again, such as field=MyField"
            ) from None
        return module

    def forward(self, batch: RangeSlices) -> Tensor:
        """Render a batch: (P, E, R, B) linear magnitude.

        Ranges need single precision. With ``precision="bf16-mixed"`` only the layers of a field
        that has layers multiply in half precision.
        """
        kind = self.device.type
        self.field.half_precision = torch.is_autocast_enabled(kind)
        with torch.autocast(kind, enabled=False):
            magnitude: Tensor = self.renderer(
                self.field, batch.position, batch.rotation, batch.rows, batch.bins
            )
        return magnitude

    def on_train_start(self) -> None:
        """Take over the length of the fit."""
        # Not earlier: Lightning would begin the first epoch before it has read a checkpoint.
        steps = float(self.trainer.estimated_stepping_batches)
        self.total_steps = int(steps) if math.isfinite(steps) else ASSUMED_STEPS
        self.steps_per_epoch = int(self.trainer.num_training_batches)

    def on_train_batch_start(self, batch: RangeSlices, batch_index: int) -> None:
        """Choose torch's threads for this step; a function of the step's state alone."""
        del batch_index
        places = self.renderer.places_per_pose
        small = places is not None and places * len(batch.pose) < WORTH_THREADS
        torch.set_num_threads(1 if small and not self.field.costly else self._threads)

    def setup(self, stage: str) -> None:
        """Note the number of torch's threads."""
        del stage
        self._threads = torch.get_num_threads()

    def teardown(self, stage: str) -> None:
        """Give all threads back."""
        del stage
        torch.set_num_threads(self._threads)

    def training_step(self, batch: RangeSlices, batch_index: int) -> Tensor:
        """Return the loss of one batch."""
        del batch_index
        step = self.global_step
        with self._own_random_numbers(step):
            self.field.advance(step, self.total_steps)
            self.renderer.advance(step, self.total_steps)
            if self.renderer.prepare(self.field, self.possible, step):
                with torch.no_grad():
                    self.renderer.calibrate(self(batch), batch.spectrum)
                    self._agree()
            loss = self._loss(self(batch), batch.spectrum)
        if self._is_logged(step):
            self.log("train/loss", loss, batch_size=len(batch.pose))
        return loss

    @contextmanager
    def _own_random_numbers(self, step: int) -> Iterator[None]:
        """Draw a step's random numbers from seed and step alone, not from the caller's generators.

        Our fields and renderers draw none; those of others may, for example by dropout.
        """
        devices = [] if self.device.type == "cpu" else [self.device]
        with torch.random.fork_rng(devices, device_type=self.device.type if devices else "cuda"):
            number = seed_of(self.options.seed, 3, step)
            if devices:
                torch.manual_seed(number)
            else:  # manual_seed asks all other kinds of device too, a tenth of a small step
                torch.default_generator.manual_seed(number)
            yield

    def _is_logged(self, step: int) -> bool:
        """Whether somebody reads this step's loss: the logger, or a preview after an epoch."""
        every = int(getattr(self._trainer, "log_every_n_steps", 1))  # Lightning sets it untyped
        written = every > 0 and (step + 1) % every == 0
        return written or (step + 1) % self.steps_per_epoch == 0 or step + 1 == self.total_steps

    def _agree(self) -> None:
        """Give all devices one gain: each was calibrated on its own share of the batch."""
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            for parameter in self.renderer.parameters():
                parameter.copy_(self.trainer.strategy.reduce(parameter.clone(), reduce_op="mean"))

    def range_db(self, step: int) -> float:
        """Return the level below the loudest cell down to which the loss counts at a step, dB."""
        if step < self.options.early_share * self.total_steps:
            return min(self.options.early_range_db, self.dynamic_range_db)
        return self.dynamic_range_db

    def _loss(self, predicted: Tensor, measured: Tensor) -> Tensor:
        span = self.range_db(self.global_step)
        reference = self._reference(measured, span)
        # The difference of both decibels by fewer passes: every cell is looked at in each step.
        error = torch.log10((predicted + reference) / (measured + reference)) * (20.0 / span)
        if self.options.loss == "l1":
            cost = error.abs()
        elif self.options.loss == "l2":
            cost = 0.5 * error.square()
        else:
            cost = error.abs() + 4.0 * error.square()
        if self.options.silent_weight != 1.0:
            loudest = torch.maximum(predicted.detach(), measured)
            silent = decibels(loudest, reference) < ACTIVE_DB
            weight = torch.where(silent, self.options.silent_weight, 1.0)
            return (cost * weight).sum() / weight.sum()
        return cost.mean()

    def _reference(self, measured: Tensor, span: float) -> Tensor:
        """Return the magnitude at which the loss starts to hear, broadcastable over the batch."""
        least = measured.new_full((), self.reference * 10 ** ((RANGE_DB - span) / 20))
        if span == self.dynamic_range_db or not self.renderer.whole_poses:
            return least
        # By the pose's own loudest echo: the flash of a flat face must not silence all others.
        faintest = self.reference * 10 ** ((RANGE_DB - self.dynamic_range_db) / 20)
        loudest = measured.amax(dim=(1, 2, 3), keepdim=True)
        return (loudest * 10 ** (-span / 20)).clamp_min(faintest)

    def configure_gradient_clipping(
        self,
        optimizer: torch.optim.Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the norm of the gradient; stop the fit if the gradient is not finite."""
        del optimizer, gradient_clip_algorithm
        named = {n: p for n, p in self.named_parameters() if p.grad is not None}
        norm = get_total_norm([p.grad for p in named.values() if p.grad is not None])
        # NaNs persist, so on a GPU it is enough to look at steps whose loss is logged.
        reads_norm = self.renderer.on_cpu or self._is_logged(self.global_step)
        if reads_norm and not bool(norm.isfinite()):
            for name, parameter in named.items():
                if parameter.grad is not None and not bool(parameter.grad.isfinite().all()):
                    raise NumericalError(
                        f"the gradient of {name} is not finite at step {self.global_step}; "
                        "the last checkpoint is sound; lower fit.learning_rate and start anew with "
                        "--overwrite"
                    )
        if gradient_clip_val is not None:
            clip_grads_with_norm_(named.values(), gradient_clip_val, norm)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse to save parameters that are not finite, so that the last checkpoint stays."""
        del checkpoint
        for name, parameter in self.named_parameters():
            if not bool(parameter.isfinite().all()):
                raise NumericalError(
                    f"{name} is not finite at step {self.global_step}; the last checkpoint is "
                    "sound; lower fit.learning_rate and start anew with --overwrite"
                )

    def validation_step(self, batch: RangeSlices, batch_index: int) -> None:
        """Gather the error over the validation poses, in reported decibels."""
        del batch_index
        self._gather(batch)

    def test_step(self, batch: RangeSlices, batch_index: int) -> None:
        """Gather the error over the test poses, in reported decibels."""
        del batch_index
        self._gather(batch)

    def _gather(self, batch: RangeSlices) -> None:
        predicted = decibels(self(batch), self.reference)
        measured = decibels(batch.spectrum, self.reference)
        error = (predicted - measured).abs()
        level = torch.as_tensor(self.active_db, dtype=error.dtype, device=error.device)
        if level.dim():
            level = level[..., batch.bins]
        active = (predicted >= level) | (measured >= level)
        self.mae.update(error)
        if bool(active.any()):
            self.mae_active.update(error[active])

    def on_validation_epoch_end(self) -> None:
        """Log the error over the validation poses: ``val/mae_db``, ``val/mae_db_active``."""
        self._report("val")

    def on_test_epoch_end(self) -> None:
        """Log the error over the test poses: ``test/mae_db``, ``test/mae_db_active``."""
        self._report("test")

    def _report(self, split: str) -> None:
        self.log(f"{split}/mae_db", self.mae.compute(), prog_bar=True, sync_dist=True)
        if self.mae_active.update_count:
            active = self.mae_active.compute()
            self.log(f"{split}/mae_db_active", active, prog_bar=True, sync_dist=True)
        self.mae.reset()
        self.mae_active.reset()

    def predict_step(self, batch: RangeSlices, batch_index: int) -> Tensor:
        """Return the linear magnitude of a batch."""
        del batch_index
        return self(batch)

    def _rate(self, step: int) -> float:
        if self.options.schedule == "staircase":
            stairs = step // (self.options.staircase_epochs * self.steps_per_epoch)
            return float(self.options.staircase_factor**stairs)
        late = max(0.0, 2.0 * step / max(1, self.total_steps) - 1.0)
        return float(self.options.final_rate_factor**late)

    def configure_optimizers(self) -> Any:
        """Return Adam and the schedule, counted in steps."""
        # Fused: a pass over the dense grids in place of ten.
        optimizer = torch.optim.Adam(self.parameters(), lr=self.learning_rate, fused=True)
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, self._rate)
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": "step"},
        }
