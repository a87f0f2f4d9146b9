"""Pretraining and training of the D(R,O) network."""
