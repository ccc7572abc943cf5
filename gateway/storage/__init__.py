"""Files of this program on the disk, for whoever keeps some: how a database is opened."""
