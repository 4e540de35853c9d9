"""Full-screen windows that show one uniform colour."""
