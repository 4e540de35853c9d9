"""Results for people: pages, figures and tables for papers."""
