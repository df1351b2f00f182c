"""What the documentation asks its readers to type."""
