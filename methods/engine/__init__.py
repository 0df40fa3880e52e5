"""What methods share: equations of motion, records, shooting, curves, weak forms, regression, derivatives."""
