"""What contacts warn of while steps are taken."""
