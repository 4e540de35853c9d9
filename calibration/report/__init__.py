"""The page that shows how a table was measured."""
