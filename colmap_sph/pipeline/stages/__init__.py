"""The stages of a run, each in a module of its own, and the contract that they share."""
