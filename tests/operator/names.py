"""Who comes to a line in tests: people and the clients they come with. Light: clients of benches import it."""

PASSWORD = "three old rollers"
USERS = {"vera": "viewer", "otto": "operator"}
PANEL, STRANGER = "panel", "stranger"  #: clients; only the first is trusted
