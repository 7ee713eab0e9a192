"""Language on the Gaussians (section 3.4, Eq. 8 to 15): fields, losses, and the methods that make fields."""
