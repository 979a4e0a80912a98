"""What of a workspace a run works on."""
