"""What may be shown of a text with secrets, what may be read of a folder of others, and how programs share one."""
