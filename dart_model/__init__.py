"""The multibody model of the bench, and every effect it can be given."""
