"""Trains the policies that `rapid` runs: reads recorded episodes, trains, exports a bundle. Never used at run time."""
