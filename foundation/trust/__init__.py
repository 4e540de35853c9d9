"""What may be shown of a text with secrets, and what may be read of a folder that somebody else made."""
