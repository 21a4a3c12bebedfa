"""WLR-Posture: sweep the legs while driving straight; data in ``configs/task/posture.yaml``."""

SUMMARY = """Drive straight on while the legs sweep from one posture to another: the two tests of the paper as a task.

First the legs go from home to the first posture; from 4 s on they sweep to the second one, each axle its own way. Legs that
turn drag their wheels along and load them unevenly, and where the floor grips the wheels unevenly that turns the robot aside.
The paper's tests are front legs at 30 degrees while rear legs go from 30 to 150, and front legs from 30 to 150 while rear legs
go from 150 to 30."""

#: Version of the environment id -> what changed.
HISTORY = {"v0": "first version"}
