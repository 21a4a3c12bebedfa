"""The live camera above the floor: a process that finds the robot in its frames, and what hands its poses to the control loop."""
