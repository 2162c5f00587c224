"""Readers of text, tables, documents and arrays of users, within bounds of size."""
