"""What users say of single nodes: linear equations between them, and loads and springs at them."""
