"""What an estimated valve would do."""
