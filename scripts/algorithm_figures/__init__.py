"""The figures of docs/algorithm.md, a module for each group of stages."""
