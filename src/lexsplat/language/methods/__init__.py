"""Methods: ways to a language field."""
