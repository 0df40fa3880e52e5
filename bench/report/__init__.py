"""What people and programs see: results and diagnoses on a terminal, JSON documents, a diagnosis as an HTML page."""
