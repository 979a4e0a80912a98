"""What a run knows from earlier ones, so that it need not be found out again when nothing has changed."""
