"""A page in the browser: robots, floor, arrows and plots, drawn by viser from the truth of any plant, without internet."""
