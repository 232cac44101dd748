# %% [markdown]
# # First mesh
# A snowman is made, heard from 100 poses around it, learned, and read out as a mesh. Two minutes on
# two cores.

# %%
import logging

import lightning
import trimesh

import sononerf as sn

logging.basicConfig()

# %% [markdown]
# ## The scene
# Any mesh will do. This one is written as an STL file in millimetres, as a CAD program does.

# %%
balls = []
for radius, height in ((20.0, -18.0), (14.0, 8.0), (9.0, 26.0)):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    balls.append(ball.apply_translation((0, 0, height)))
trimesh.util.concatenate(balls).export("snowman.stl")
scene = sn.Scene.load("snowman.stl", unit="mm")

# %% [markdown]
# ## The echoes
# A head with two ears calls from 100 poses at 40 cm. Ten of them are held out.

# %%
poses = sn.Poses.sphere(100, radius=0.4)
echoes = sn.simulate(scene, poses, sn.Head(), options={"accuracy_db": 0.5})
number = int(echoes.numbers_of(echoes.poses("test"))[0])
echoes.plot(number).save("heard.png")

# %% [markdown]
# ## The field
# A Lightning Trainer fits it.

# %%
model = sn.EchoModule.for_echoes(echoes)
trainer = lightning.Trainer(max_epochs=15, logger=False, enable_checkpointing=False)
trainer.fit(model, sn.EchoDataModule(echoes))

# %% [markdown]
# ## The surface
# It is read out of the field and of the first echoes, then refined against the spectrograms.

# %%
surface = sn.refine(sn.reconstruct(model, echoes), echoes)
surface.save("mesh.ply")
print(sn.evaluate(surface, scene))

# %% [markdown]
# ## Poses that were never heard

# %%
heard = sn.predict(model, surface, echoes.poses("test"))
print(sn.compare(heard, echoes))
echoes.plot(number, heard).save("predicted.png")
