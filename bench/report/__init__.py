"""What people and programs see of a diagnosis: text, JSON, and an HTML page."""
