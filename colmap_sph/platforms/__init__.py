"""What operating systems do each in their own way: the only room that asks on which one it is."""
