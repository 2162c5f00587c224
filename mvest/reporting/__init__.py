"""From estimates to tables, figures and views."""
