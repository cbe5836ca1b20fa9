"""Universal Manipulation Interface: the file of a checkpoint of its DiffusionUnetTimmPolicy, computed by networks here.

The facts are those of <https://github.com/real-stanford/universal_manipulation_interface>; each module names the files
it follows. Of rapid_policy it has the U-Net and the blocks of ResNet, which are the same networks.

Invariant: no code of a checkpoint is run, and every weight in it has its place here: a missing or a surplus one is
refused.
"""
