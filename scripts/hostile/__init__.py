"""Hostile input of every kind, tried on the command, and verdicts on what it made of it.

Each module imports only those before it: shim, runs, grounds, watch, cases, verdicts, damage, the kinds of cases
(names, places, headers, records, clouds, pictures, masks, numbers, settings, workspaces, faults), kinds, campaign.
"""
