# SPDX-License-Identifier: MIT
import itertools
import subprocess
import sys
from types import SimpleNamespace

import lightning
import numpy as np
import pytest
import torch

from sononerf.echoes.store import EnsembleStore
from sononerf.field.datamodule import EchoDataModule, EpochSampler

POSES, RANGES, FREQUENCIES = 12, 5, 4
SPLIT = np.array([0, 0, 1, 0, 2, 0, 0, 2, 0, 1, 0, 0])


def make(path, split=SPLIT):
    store = EnsembleStore.create(
        path,
        positions=np.random.default_rng(0).normal(size=(POSES, 3)),
        rotations=np.tile(np.eye(3), (POSES, 1, 1)),
        split=split,
        range=0.2 + 0.01 * np.arange(RANGES),
        frequency=1e4 * (1 + np.arange(FREQUENCIES)),
        attributes={"echo_hash": "a"},
    )
    for pose in range(POSES):
        values = np.random.default_rng(pose).random((2, RANGES, FREQUENCIES))
        store.write_pose(pose, values)
    return EnsembleStore.open(path)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return make(tmp_path_factory.mktemp("data") / "store")


def module(store, *, whole_poses=True, workers=0, memory_bytes=2_000_000_000, **options):
    given = {"batch_frequencies": 2, "seed": 4, **options}
    size = given.pop("batch", 3)
    given |= {"batch_poses": size, "batch_slices": size}
    heard = SimpleNamespace(store=store, reference=1.0)
    return EchoDataModule(
        heard, given, whole_poses=whole_poses, workers=workers, memory_bytes=memory_bytes
    )


def first(loader, count):
    return list(itertools.islice(iter(loader), count))


def assert_same(one, two):
    assert len(one) == len(two)
    for a, b in zip(one, two, strict=True):
        for x, y in zip(a, b, strict=True):
            assert torch.equal(x, y)


# The stream is endless; a worker that is left in the middle of it sometimes aborts as it exits.
@pytest.mark.filterwarnings(
    "ignore:.*_MultiProcessingDataLoaderIter.__del__:pytest.PytestUnraisableExceptionWarning"
)
@pytest.mark.parametrize("whole", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_workers_change_nothing(store, whole):
    found = [
        first(module(store, whole_poses=whole, workers=workers).train_dataloader(), 7)
        for workers in (0, 2)
    ]
    assert_same(*found)
    stream = module(store, whole_poses=whole).stream()
    assert_same(found[0], [stream[step] for step in range(7)])


def test_an_interrupted_fit_goes_on_where_it_stopped(store):
    whole = list(module(store, steps_per_epoch=9).train_dataloader())
    resumed = module(store, steps_per_epoch=9)
    resumed.trainer = SimpleNamespace(
        global_rank=0, world_size=1, max_steps=-1, global_step=5, accumulate_grad_batches=1
    )
    assert_same(list(resumed.train_dataloader()), whole[5:])


@pytest.mark.parametrize(
    ("done", "steps"), [(0, [0, 1, 2]), (1, [1, 2]), (3, [3, 4, 5]), (8, [8]), (9, [9, 10, 11])]
)
def test_an_epoch_begins_where_the_steps_before_ended(done, steps):
    sampler = EpochSampler(3, lambda: done)
    assert list(sampler) == steps
    assert len(sampler) == 3


@pytest.mark.parametrize(
    ("steps", "most", "expected"),
    [("auto", -1, 60), (4, -1, 4), ("auto", 7, 7), (4, 2, 2), (4, 5, 4)],
)
def test_an_epoch_has_at_least_sixty_steps_unless_somebody_says_how_many(
    store, steps, most, expected
):
    data = module(store, steps_per_epoch=steps)
    data.trainer = SimpleNamespace(global_rank=0, world_size=1, max_steps=most)
    assert data.steps_per_epoch == expected


def test_splits_are_by_pose_and_never_mixed(store):
    data = module(store)
    trained = {int(p) for batch in first(data.train_dataloader(), 30) for p in batch.pose}
    assert trained == set(np.flatnonzero(SPLIT == 0))
    for loader, number in (
        (data.val_dataloader(), 1), (data.test_dataloader(), 2), (data.predict_dataloader(), 2)
    ):  # fmt: skip
        found = list(loader)
        poses = [int(batch.pose) for batch in found]
        assert poses == np.flatnonzero(SPLIT == number).tolist()
        for batch, pose in zip(found, poses, strict=True):
            np.testing.assert_array_equal(batch.spectrum[0], store.read_pose(pose))
            np.testing.assert_allclose(batch.position[0], store.positions[pose], rtol=1e-6)
            assert batch.rows.tolist() == [list(range(RANGES))]
            assert batch.bins.tolist() == list(range(FREQUENCIES))


def test_without_validation_poses_there_is_no_loader(tmp_path):
    data = module(make(tmp_path / "store", np.zeros(POSES, int)))
    assert data.val_dataloader() == []


def test_each_device_gets_its_share(store):
    alone = module(store, batch=6).stream()
    poses = []
    for rank in (0, 1):
        data = module(store, batch=6)
        data.trainer = SimpleNamespace(global_rank=rank, world_size=2, max_steps=-1)
        poses.append(data.stream()[3].pose)
    assert torch.equal(torch.stack(poses, 1).reshape(-1), alone[3].pose)


def test_a_batch_goes_to_the_device_and_stays_as_it_is_on_a_cpu(store):
    found = module(store)
    given = found.stream()[0]
    assert found.transfer_batch_to_device(given, torch.device("cpu"), 0) is given
    moved = found.transfer_batch_to_device(given, torch.device("meta"), 0)
    assert {part.device.type for part in moved} == {"meta"}


@pytest.mark.filterwarnings("ignore:You requested to overfit:UserWarning")
def test_lightning_can_fit_the_same_few_batches_over_and_over(store, tmp_path):
    class Sum(lightning.LightningModule):
        def __init__(self):
            super().__init__()
            self.factor = torch.nn.Parameter(torch.ones(()))
            self.met = []

        def training_step(self, batch, number):
            self.met.append(batch.pose.tolist())
            return self.factor * batch.spectrum.sum()

        def configure_optimizers(self):
            return torch.optim.SGD(self.parameters(), lr=1e-3)

    model = Sum()
    trainer = lightning.Trainer(
        max_epochs=2, overfit_batches=2, accelerator="cpu", logger=False,
        enable_checkpointing=False, enable_progress_bar=False, default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(model, train_dataloaders=module(store).train_dataloader())
    assert trainer.global_step == 4
    assert model.met[:2] == model.met[2:]


SCRIPT = """
import sys
from pathlib import Path
from types import SimpleNamespace
from sononerf.echoes.store import EnsembleStore
from sononerf.field.datamodule import EchoDataModule
print("script runs", flush=True)
heard = SimpleNamespace(store=EnsembleStore.open(Path(sys.argv[1])), reference=1.0)
data = EchoDataModule(heard, {"batch_poses": 3}, whole_poses=True, workers=2)
print(sum(1 for _ in data.train_dataloader()), flush=True)
"""


@pytest.mark.slow
def test_a_script_without_a_main_guard_may_have_workers(tmp_path):
    path = make(tmp_path / "store").path
    (tmp_path / "script.py").write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, tmp_path / "script.py", path], capture_output=True, text=True, timeout=120,
        check=True,
    )  # fmt: skip
    assert done.stdout.split("\n")[:2] == ["script runs", "60"]
