"""The whole loop: learn, compare on ice, drive a robot with a hidden fault, name it, validate it, train on; one page."""
