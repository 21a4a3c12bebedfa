"""Learning: training, and the evaluation that policies are judged by."""
