"""Safety: rules that stop the robot, the command limiter, preflight checks, the watchdog process."""
