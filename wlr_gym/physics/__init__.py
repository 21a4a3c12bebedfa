"""Physics: plants that can be driven, the effects that may act in them, and the servo and mechanics they share."""
