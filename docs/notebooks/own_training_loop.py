# %% [markdown]
# # Own training loop
# Field and renderer are torch modules. This notebook trains them without a Trainer, on echoes that
# it makes up.

# %%
import numpy as np
import torch

import sononerf as sn

# %% [markdown]
# ## Echoes
# Three points in front of a head whose ears hear alike in all directions. `Echoes.from_arrays`
# takes any spectrograms (poses, receivers, ranges, frequencies) over the axes of the head.

# %%
head = sn.Head(
    ears={"directivity": "omnidirectional", "beam_radius": 0},
    spectrogram={"range_min": 0.2, "range_max": 0.3},
)
poses = sn.Poses.sphere(80, radius=0.25)
emitters, receivers = head.places(poses.positions, poses.rotations)
heard = np.zeros((len(poses), len(head.receivers), len(head.range), len(head.frequency)))
for point in ((0.0, 0.0, 0.015), (0.012, 0.0, -0.01), (-0.01, 0.012, 0.0)):
    out = np.linalg.norm(emitters - point, axis=-1)[:, None]
    back = np.linalg.norm(receivers - point, axis=-1)
    apart = head.range - (out + back)[..., None] / 2
    heard += np.exp(-((apart / head.resolution) ** 2))[..., None]
echoes = sn.Echoes.from_arrays(heard, poses, head)

# %% [markdown]
# ## The loop
# A batch is a function of its number. `advance` and `prepare` tell field and renderer how far the
# fit is; `calibrate` sets the gain where the renderer asks for it.

# %%
steps = 300
model = sn.EchoModule.for_echoes(echoes, options={"seed": 1})
stream = sn.EchoDataModule(echoes, model.options).stream()
optimizer = torch.optim.Adam(model.parameters(), lr=model.learning_rate)


def level(magnitude: torch.Tensor) -> torch.Tensor:
    """Return reported decibels; 0 is silence."""
    return 20 * torch.log10(1 + magnitude / echoes.reference)


for step in range(steps):
    batch = stream[step]
    model.field.advance(step, steps)
    model.renderer.advance(step, steps)
    if model.renderer.prepare(model.field, model.possible, step):
        with torch.no_grad():
            model.renderer.calibrate(model(batch), batch.spectrum)
    loss = (level(model(batch)) - level(batch.spectrum)).abs().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    if step % 100 == 0 or step == steps - 1:
        print(f"step {step}: {loss.item():.2f} dB")

# %% [markdown]
# ## Unheard poses

# %%
predicted = sn.predict(model, None, echoes.poses("test"))
found = sn.compare(predicted, echoes)
print(found)
assert found["mae_db"] < 0.5 * found["mean_predictor_mae_db"]
