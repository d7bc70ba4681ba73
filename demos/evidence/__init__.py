"""What the evidence is made of: other methods of contact on the same surfaces, problems with known answers, extreme cases."""
