"""Readers with size limits for users' text, tables, documents and arrays."""
