# %% [markdown]
# # Own recordings
# WAV files and a table of poses become echoes, a field and a mesh. Here the recordings are
# simulated, so that the notebook runs anywhere; a folder of your own looks the same.

# %%
import logging
import subprocess
import sys

import sononerf as sn

logging.basicConfig()

# %% [markdown]
# ## The folder
# One WAV file per call, `poses.csv`, and `import.yaml` with air, ears, call and analysis.

# %%
settings = ["scene.name=sphere", "scene.options.radius=0.03", "poses.count=60"]
settings += ["poses.validation=5", "poses.heldout=5", "simulation.accuracy_db=0.5"]
command = [sys.executable, "-m", "sononerf.cli", "simulate", *settings]
subprocess.run([*command, "--output", "data/direct", "--waveforms", "recordings"], check=True)

# %% [markdown]
# ## The import
# What the first echoes say against the poses (a mirrored frame, a wrong unit) is a warning.

# %%
echoes = sn.read_recordings("recordings", "data/mine")
print(len(echoes), "pings;", len(echoes.poses("train")), "train")
echoes.plot(0).save("ping.png")

# %% [markdown]
# ## Field and surface

# %%
model = sn.fit(echoes, options={"epochs": 10})
surface = sn.refine(sn.reconstruct(model, echoes), echoes)
surface.save("mesh.ply")
radius = surface.mesh.extents / 2
print("radii of the ball, mm:", (1e3 * radius).round(1))

# %% [markdown]
# ## What was held out

# %%
heard = sn.predict(model, surface, echoes.poses("test"))
print(sn.compare(heard, echoes))
