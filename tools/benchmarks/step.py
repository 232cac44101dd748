# SPDX-License-Identifier: MIT
"""What one step of a fit costs: each field through each renderer, and equation 17 as it stands.

Every pair takes its steps in Lightning's own loop, as ``sononerf fit`` does, from a batch of the
ensemble to the optimiser's update; what is reported is the median over the timed ones. Beside it:

How far a loss lies from that of the exact renderer, or in float32, is told for the same batch and
the same weights. *Floating-point operations* are those of the matrix products that were executed,
forward and backward, as torch counts them, in one more step; the rate is given over that of a plain
product of two matrices of the same type on the same machine.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from sononerf import storage
from sononerf.field.datamodule import EchoDataModule
from sononerf.field.field import Field
from sononerf.field.fields import FourierField
from sononerf.field.fitting import quiet_lightning, usable_accelerator
from sononerf.field.module import EchoModule
from sononerf.field.renderer import ShellRenderer
from sononerf.progress import Progress
from sononerf.run.simulate import default_store, echo_hash, head_of, open_or_simulate
from sononerf.scene.scene import load_scene
from sononerf.settings.loading import load_settings
from sononerf.settings.schema import Settings
from tools.benchmarks.experiment import CONFIG, Row, aligned, device_name, ending, keep, ratios

PAPER = CONFIG.parent / "paper" / "three_spheres.yaml"
NEURAL = CONFIG.parent / "neural.yaml"


class Pair(NamedTuple):
    """A field and a renderer, and at which steps of their fit they are timed."""

    name: str
    config: Path
    settings: tuple[str, ...]
    warm: int
    timed: int


PAIRS = (
    Pair("equation 17", PAPER, (), 1, 5),
    Pair("fourier, shell", PAPER, (), 5, 20),
    Pair("grid, shell", PAPER, ("field.kind=grid",), 5, 20),
    Pair("grid, profile", CONFIG, (), 200, 50),
    Pair("fourier, profile", NEURAL, ("field.options.precision=float32",), 5, 20),
    Pair("fourier in bfloat16, shell", PAPER, ("field.options.precision=bfloat16",), 5, 20),
    Pair("fourier in bfloat16, profile", NEURAL, ("field.options.precision=bfloat16",), 5, 20),
)
NAIVE, SHELL = PAIRS[0].name, PAIRS[1].name


class EquationSeventeen(ShellRenderer):
    """The paper's equation written down: every direction of every slice, zero outside the region.

    The field is evaluated once for both ears, in float32. The yardstick, and nothing else; its
    parameters and what it looks up are those of renderer ``shell``.
    """

    def forward(
        self,
        field: Field,
        position: Tensor,
        rotation: Tensor,
        rows: Tensor,
        bins: Tensor | None = None,
    ) -> Tensor:
        """Render; all frequencies."""
        del bins
        if not isinstance(field, FourierField):
            raise TypeError(f"a {type(field).__name__}, expected the paper's network")
        self.points_evaluated += rows.numel() * len(self.directions)
        world = torch.einsum("pij,dj->pdi", rotation, self.directions)
        places = position[:, None, None] + self.range[rows][..., None, None] * world[:, None]
        toward = (-world)[:, None].expand(places.shape)
        response = _network(field, places, toward)  # (P, R, D, F)
        lower, upper = field.region
        inside = ((places >= lower) & (places <= upper)).all(dim=-1, keepdim=True)
        response = response * inside
        phase = torch.exp(2j * torch.pi * self.frequency * self.range[rows][..., None] / 343.0)
        heard = []
        for ear in self.transfer:  # (D, F)
            total = (response * ear).sum(dim=2) * phase
            heard.append(total.abs())
        scale = (self.log_gain + self.log_spectrum).exp() / len(self.directions)
        return torch.stack(heard, dim=1) * scale


def _network(field: FourierField, places: Tensor, toward: Tensor) -> Tensor:
    embedded = torch.cat(
        [
            torch.sin(x[..., None] * f).flatten(-2)
            for x, f in ((places * field.scale, field._first), (toward, field._turns))
        ],
        dim=-1,
    )
    hidden = field.trunk(embedded)
    hidden = field.branch(torch.cat((hidden, embedded), dim=-1))
    real, imaginary = field.out(field.head(torch.cat((hidden, embedded), dim=-1))).chunk(2, dim=-1)
    return torch.complex(real, imaginary)


class Stopwatch(lightning.Callback):
    """Times the steps after the first ones, counts in one more, and stops."""

    def __init__(self, warm: int, timed: int, counted: bool) -> None:
        self.warm, self.timed, self.counted = warm, timed, counted
        self.seconds: list[float] = []
        self.points: list[int] = []
        self.flop = 0
        self._counter: FlopCounterMode | None = None
        self._began = 0.0

    def on_train_batch_start(
        self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int
    ) -> None:
        """Start the clock, or the counting."""
        del batch, batch_idx
        if trainer.global_step == self.warm + self.timed and self.counted:
            self._counter = FlopCounterMode(display=False)
            self._counter.__enter__()
        self._points = int(pl_module.renderer.points_evaluated)
        self._settle()
        self._began = time.perf_counter()

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Stop it."""
        del outputs, batch, batch_idx
        self._settle()
        trainer.should_stop = trainer.global_step >= self.warm + self.timed + self.counted
        if self._counter is not None:
            self._counter.__exit__(None, None, None)
            self.flop = self._counter.get_total_flops()
            self._counter = None
        elif trainer.global_step > self.warm:
            self.seconds.append(time.perf_counter() - self._began)
            self.points.append(int(pl_module.renderer.points_evaluated) - self._points)

    @staticmethod
    def _settle() -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()


def step(arguments: argparse.Namespace) -> str:
    """Time a step of each field through each renderer, beside equation 17 as it stands."""
    output = arguments.output or Path("runs") / "step"
    with ending(output):
        return _step(arguments, output)


def _step(arguments: argparse.Namespace, output: Path) -> str:
    arguments.accelerator = usable_accelerator(arguments.accelerator)
    quiet_lightning()
    if arguments.compare is not None:
        storage.read_json(arguments.compare)  # that it cannot be read is told before minutes pass
    chosen = [_settings(pair, arguments, output) for pair in PAIRS]  # wrong ones cost no minutes
    device = device_name(arguments.accelerator)
    products = {kind: matrix_rate(device, kind) for kind in ("float32", "bfloat16")}
    rows: list[Row] = []
    for pair, settings in zip(PAIRS, chosen, strict=True):
        rows.append(_measured(pair, settings, arguments.accelerator, products))
        print(f"{pair.name}: {1e3 * rows[-1]['step_s']:.1f} ms", file=sys.stderr, flush=True)
    by_name = {row["name"]: row for row in rows}
    found = {
        "scene": arguments.scene,
        "matrix_flop_per_s": products,
        "shell_over_equation_17": by_name[NAIVE]["step_s"] / by_name[SHELL]["step_s"],
        "loss_of_equation_17_differs_by": by_name[NAIVE]["loss_differs"],
        "rows": rows,
    }
    path = keep(output, "step", device, found)
    text = f"{table(rows)}\n{sentences(found)}\nwrote {path}"
    return text if arguments.compare is None else f"{text}\n{ratios(arguments.compare, found)}"


def _settings(pair: Pair, arguments: argparse.Namespace, output: Path) -> Settings:
    chosen = [f"scene.name={arguments.scene}", *pair.settings, *arguments.set]
    settings = load_settings(pair.config, chosen)
    scene = load_scene(settings.scene.name, settings.scene.options)
    store = default_store(settings, echo_hash(settings, scene)).name
    folder = arguments.data or output / "data"
    return load_settings(pair.config, [*chosen, f"data.store={folder / store}"])


def _measured(pair: Pair, settings: Settings, accelerator: str, products: dict[str, float]) -> Row:
    echoes = open_or_simulate(settings, progress=Progress())
    module = EchoModule.for_echoes(
        echoes,
        settings.field.kind,
        settings.renderer.kind,
        field_options=settings.field.options,
        renderer_options=settings.renderer.options,
        options=settings.fit,
    )
    field, region = module.field, module.field.region
    naive = pair.name == NAIVE
    if naive:
        own = module.renderer.state_dict()
        torch.manual_seed(settings.fit.seed)
        renderer = EquationSeventeen(region, echoes.head, **settings.renderer.options)
        renderer.load_state_dict(own)
        module.renderer = renderer
    options = settings.fit
    data = EchoDataModule(echoes, workers=settings.data.workers)
    watch = Stopwatch(pair.warm, pair.timed, counted=not naive)
    trainer = lightning.Trainer(
        accelerator=accelerator,
        devices=1,
        max_epochs=options.epochs,
        limit_val_batches=0,
        num_sanity_val_steps=0,
        gradient_clip_val=options.gradient_clip,
        logger=False,
        callbacks=[watch],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, data)
    seconds, points = statistics.median(watch.seconds), statistics.median(watch.points)
    row: Row = {
        "name": pair.name,
        "steps": [pair.warm + 1, pair.warm + pair.timed],
        "step_s": seconds,
        "points": points,
        "points_per_s": points / seconds,
    }
    if naive:
        row["loss_differs"] = _loss_differs(module, data, settings, region)
        return row
    if isinstance(field, FourierField) and field.precision != "float32":
        row["loss_differs"] = _loss_in_float32_differs(module, field, data)
    product = products[getattr(field, "precision", "float32")]
    return {
        **row,
        "flop": watch.flop,
        "flop_per_s": watch.flop / seconds,
        "over_matrix_rate": watch.flop / seconds / product,
    }


def _loss_differs(
    module: EchoModule, data: EchoDataModule, settings: Settings, region: Tensor
) -> float:
    """Return by how much, of itself, the loss through ``shell`` differs from equation 17's."""
    shell = ShellRenderer(region, head_of(settings), **settings.renderer.options)
    shell.load_state_dict(module.renderer.state_dict())
    batch = next(iter(data.train_dataloader()))
    plain = module.cpu().renderer
    losses = []
    with torch.no_grad():
        for renderer in (plain, shell):
            module.renderer = renderer
            losses.append(float(module._loss(module(batch), batch.spectrum)))
    return abs(losses[1] / losses[0] - 1)


def _loss_in_float32_differs(
    module: EchoModule, field: FourierField, data: EchoDataModule
) -> float:
    """Return by how much, of itself, the loss differs from that with products in float32."""
    batch = next(iter(data.train_dataloader()))
    chosen, losses = field.precision, []
    module.cpu().eval()  # a step that draws places would draw others
    with torch.no_grad():
        for field.precision in ("float32", chosen):
            losses.append(float(module._loss(module(batch), batch.spectrum)))
    return abs(losses[1] / losses[0] - 1)


def matrix_rate(device: str, kind: str = "float32", size: int | None = None) -> float:
    """Return the floating-point operations a second of a product of two square matrices."""
    size = size or (8192 if device == "cuda" else 2048)
    one = torch.rand(size, size, device=device, dtype=getattr(torch, kind))
    return 2 * size**3 / _median_seconds(lambda: one @ one, device)


def _median_seconds(run: Callable[[], object], device: str) -> float:
    seconds = []
    for _ in range(8):
        began = time.perf_counter()
        run()
        if device == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds[1:])


TITLES = ("pair", "steps", "ms", "points/s", "GFLOP", "of peak", "loss apart")


def table(rows: list[Row]) -> str:
    """Return one line for each pair."""

    def shown(value: float | None, form: str, scale: float = 1.0) -> str:
        return "-" if value is None else f"{scale * value:{form}}"

    lines = [list(TITLES)]
    lines += [
        [
            row["name"],
            "{} to {}".format(*row["steps"]),
            shown(row["step_s"], ".1f", 1e3),
            shown(row["points_per_s"], ",.0f"),
            shown(row.get("flop"), ".2f", 1e-9),
            shown(row.get("over_matrix_rate"), ".0%"),
            shown(row.get("loss_differs"), ".0e"),
        ]
        for row in rows
    ]
    return "\n".join(aligned(lines))


def sentences(found: dict[str, Any]) -> str:
    """Return what the table comes to."""
    rates = found["matrix_flop_per_s"]
    return (
        f"matrix product {rates['float32'] / 1e9:.0f} GFLOP/s, "
        f"in bfloat16 {rates['bfloat16'] / 1e9:.0f} GFLOP/s\n"
        f"fourier, shell: {found['shell_over_equation_17']:.1f} times as fast as equation 17, "
        f"loss {found['loss_of_equation_17_differs_by']:.0e} apart"
    )
