"""The robot as a :class:`wlr_gym.gap.problem.Problem`: whole runs replayed in a simulator, many settings at once."""
