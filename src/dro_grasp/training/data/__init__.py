"""Grasp data sets: shards, the engine that fills them, the training bundle."""
