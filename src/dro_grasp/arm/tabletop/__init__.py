"""The experiment: a simulated table that a camera sees, one attempt after the other, counted and drawn."""
