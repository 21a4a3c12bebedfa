"""The live camera above the floor: a process that finds the robot in its frames and hands poses to the control loop."""
