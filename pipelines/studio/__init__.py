"""The studio: sessions, tasks, access control and HTTP interface."""
