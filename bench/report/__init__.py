"""What people and programs see: a diagnosis as text, JSON and HTML page, and the JSON documents of all commands."""
