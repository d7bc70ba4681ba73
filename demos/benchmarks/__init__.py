"""What studies measure and with what: rival methods, other codes, problems with known answers, extreme cases, and the report."""
