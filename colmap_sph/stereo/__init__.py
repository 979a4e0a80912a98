"""The method, from who sees the same to the cloud: pure functions of arrays and frozen records."""
