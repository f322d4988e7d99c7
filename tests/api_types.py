"""The types of the API in a user's script, which `make check` lets mypy --strict read. Each wrong line below
has an error that mypy must find: an unused `type: ignore` is an error itself."""

from pathlib import Path
from typing import assert_type

import numpy as np

import memmlp

run = memmlp.load_run("0123", outputs="outputs")
assert_type(memmlp.Runs("outputs")[0], memmlp.TrainedRun)
assert_type(memmlp.Runs()[1:], memmlp.Runs)
assert_type(run.results["stream"]["rotation"]["MPJPE"], float)
prediction = run.predict("clip", mode="window")
assert_type(prediction, memmlp.Prediction)
prediction.draw("clip.gif", begin=1, end=2.5)
assert_type(prediction.save("clip.glb", truth=True), Path)
assert_type(run.model.count_parameters(), int)
offsets = memmlp.Offsets(np.zeros((3, 3)), np.zeros((3, 3, 3)))
pose = memmlp.Stream(run, space="unity", offsets=offsets).step(((0, 1, 0), np.eye(3)), None, None, time=0.5)
assert_type(pose, memmlp.Pose)
assert_type(run.stream(rotations="quaternion"), memmlp.Stream)

memmlp.load_run("0123", output="outputs")  # type: ignore[call-arg]
memmlp.load_run(3)  # type: ignore[arg-type]
memmlp.Runs(folder="outputs")  # type: ignore[call-arg]
memmlp.Runs()[0].per_clips()  # type: ignore[attr-defined]
run.predict("clip", mod="window")  # type: ignore[call-arg]
run.predict("clip", "windows")  # type: ignore[arg-type]
run.seed = "0"  # type: ignore
run.stream(spcae="unity")  # type: ignore[call-arg]
prediction.draw("a.png", frames=3)  # type: ignore[call-arg]
prediction.error()  # type: ignore[attr-defined]
prediction.save("clip.glb", thruth=True)  # type: ignore[call-arg]
memmlp.Stream("run", space="untiy")  # type: ignore[arg-type]
print(memmlp.Stream("run").step(None, None, None).position)  # type: ignore[attr-defined]
memmlp.Strem("run")  # type: ignore[attr-defined]
