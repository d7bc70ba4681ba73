"""General contact: any body with any other and with itself."""
