"""The web server of the console: accepts connections, checks what browsers send, and has the second stop."""
