"""CPU seconds and environment steps to an imitating student, side by side with other libraries."""
