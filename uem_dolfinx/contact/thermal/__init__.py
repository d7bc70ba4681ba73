"""Heat through contacts."""
