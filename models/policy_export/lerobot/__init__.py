"""LeRobot's DiffusionPolicy: the folder of a checkpoint, computed by LeRobot itself.

Invariant: `config` needs no LeRobot: a checkpoint is refused before anything large is loaded.
"""
