"""The slip observer: how its trust in the wheels is trained, and how accurate it is."""
