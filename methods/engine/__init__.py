"""What methods share: dynamics with sensitivities, derivatives, regression."""
