"""What bags and logs share: which field becomes which column, messages at any time brought to even rows."""
