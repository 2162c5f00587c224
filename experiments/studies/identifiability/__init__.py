"""What data can tell, before any are taken."""
